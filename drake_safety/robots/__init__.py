"""What a robot is: ``robot.yaml`` and its model file, meshes, postures, and what ``new`` writes."""
