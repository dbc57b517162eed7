"""Worlds from elsewhere and random ones, written as scenario files with a suite."""
