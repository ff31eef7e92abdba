"""Conditions under which a device bears a coupling, and their verdict after a run.

Read ``loop_setting`` first: device, law, period and scales as the theory sees them. ``methods`` are
the ways to couple a tool. ``certificate`` has the conditions on damping and friction, and the
default coupling that meets them; ``plots`` draws their bounds. ``guard`` sets the limits of the
loop, ``trip`` is its stop of a run. ``timekeeping`` judges the conditions at the times of a run,
``certification`` is the verdict on the device in words. ``rehearsal`` is a run without device.
"""
