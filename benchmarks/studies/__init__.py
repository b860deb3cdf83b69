"""Studies of safety, success, accuracy and parameters."""
