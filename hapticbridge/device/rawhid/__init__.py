"""Home-made devices with the open protocol of ``device/rawhid.md``.

``device`` is the driver, ``protocol`` the frames in bytes, ``serial`` the frames on a serial port.
"""
