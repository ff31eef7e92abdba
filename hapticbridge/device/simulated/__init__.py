"""A simulated device in a simulated hand."""
