"""Home-made devices that speak the open protocol of ``device/rawhid.md``.

``driver`` is the device; ``frame`` is the protocol in bytes, ``stream`` what comes of it, ``sheet``
what the device says of itself, ``finding`` how it is opened.
"""
