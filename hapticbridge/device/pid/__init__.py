"""USB force-feedback sticks (class PID)."""
