"""A simulated arm behind the same interfaces as the real one: in its own process and real time, or in lockstep."""
