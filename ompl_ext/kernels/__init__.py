"""Kernels compiled by numba: Algorithm 1, the tree, propagation and checks in lanes, clearance, cost-to-go."""
