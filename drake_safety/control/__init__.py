"""Robot mathematics on arrays: kinematics, whole-body control, footholds and safe sets."""
