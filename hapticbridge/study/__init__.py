"""Studies: theory and runs, swept, drawn and written down."""
