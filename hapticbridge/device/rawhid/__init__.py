"""Home-made devices that speak the open protocol of ``device/rawhid.md``."""
