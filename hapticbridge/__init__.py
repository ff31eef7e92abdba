"""Feel a MuJoCo scene through a haptic device, with a metered guarantee."""
