"""Logs for identification: open-loop manoeuvres, driven in simulation and measured by the camera."""
