"""Execute runs, sweep over settings, measure, report and benchmark."""
