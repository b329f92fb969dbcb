"""Assessment and selection of goals and plans before the robot moves."""
