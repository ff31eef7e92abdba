"""The arithmetic of a tick, compiled, around MuJoCo's step."""
