"""Walking policies: `policy.yaml`, observation terms, networks and their memory."""
