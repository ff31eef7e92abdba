"""The Novint Falcon, over USB.

``driver`` is the device, ``finding`` how it is opened. ``packets`` are its 16 bytes each way,
``motion`` what a tick does with them, by ``kinematics`` and ``statics``; ``boot``, ``start`` and
``timing`` come before the loop.
"""
