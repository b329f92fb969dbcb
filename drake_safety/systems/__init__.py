"""LeafSystems of the closed loop, one a file; each is usable alone."""
