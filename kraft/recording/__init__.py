"""Recording logs for identification: nominal open-loop manoeuvres, driven in simulation and seen by a camera."""
