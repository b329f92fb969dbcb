"""Files and folders written whole, and the progress of long computations."""
