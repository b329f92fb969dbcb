"""Simulated plants: Drake and MuJoCo behind one interface; ground, obstacles, balls and pushes."""
