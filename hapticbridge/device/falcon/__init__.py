"""Novint Falcon, over USB.

``driver`` is the device and ``finding`` opens it. ``packets`` encodes and decodes its 16 bytes in
each direction. ``motion`` processes them in a tick, with ``kinematics`` and ``statics``. ``boot``,
``start`` and ``timing`` run before the loop.
"""
