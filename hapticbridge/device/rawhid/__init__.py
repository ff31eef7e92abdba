"""Home-made devices with the open protocol of ``device/rawhid.md``.

``driver`` is the device and ``frame`` the protocol in bytes. ``stream`` decodes its states,
``sheet`` reads its data sheet, and ``finding`` opens it.
"""
