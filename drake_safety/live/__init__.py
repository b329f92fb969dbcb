"""The live page: a robot in Meshcat, in real time, beside what is said of it."""
