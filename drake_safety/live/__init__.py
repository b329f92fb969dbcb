"""Live sessions: a robot in Meshcat, in real time, with Γ and the verdict beside it."""
