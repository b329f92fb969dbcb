"""Files of other projects, read into `robot.yaml`, `policy.yaml` and a scenario."""
