"""USB force-feedback sticks of the class PID."""
