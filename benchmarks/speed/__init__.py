"""Speed: of the controller, the environments, training, and its regression gate."""
