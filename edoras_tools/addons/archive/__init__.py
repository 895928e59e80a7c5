"""An index of many recordings: made in parallel, brought up to date, asked, reported on, exported."""
