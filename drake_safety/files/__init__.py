"""Files written whole, strict YAML and its errors, and the progress of long computations."""
