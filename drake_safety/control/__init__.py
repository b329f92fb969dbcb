"""Robot mathematics on arrays: kinematics, footholds and safe sets; no ports, no learning."""
