"""The Novint Falcon, over USB."""
