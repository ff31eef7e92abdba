"""Home-made devices with the open protocol of ``device/rawhid.md``."""
