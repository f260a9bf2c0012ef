"""Real devices and the loop that runs them: actuators, pose sensors, guards, the runner and its logs."""
