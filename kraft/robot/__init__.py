"""Robots on their topics: messages, bags, robot files, transports, the runtime on board, and the simulated robot."""
