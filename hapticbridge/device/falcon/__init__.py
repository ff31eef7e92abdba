"""Novint Falcon, over USB.

``device`` is the driver, ``protocol`` its packets, firmware upload and start, ``kinematics`` the
geometry and statics of its three legs.
"""
