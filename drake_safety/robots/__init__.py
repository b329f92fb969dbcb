"""Robot descriptions: ``robot.yaml``, model files, meshes, postures, and new robots."""
