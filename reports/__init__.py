"""Notebooks in percent format, packaged: ``styleexp-report FOLDER --notebooks`` executes them."""
