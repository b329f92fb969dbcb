"""Engines behind one face: Drake's plant and MuJoCo's, ground, obstacles, balls and pushes."""
