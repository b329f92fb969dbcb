"""Tasks, one module each, and scenarios, one YAML file each."""
