"""Motion capture by OptiTrack: a NatNet client of our own around the `natnet` package's frame parser."""
