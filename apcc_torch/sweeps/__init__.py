"""Sets of runs: hydra's sweeps with their folder and bars, and sweeps as rows of one tensor batch."""
