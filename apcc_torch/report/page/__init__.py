"""The one-file HTML page of a set of runs: `html` fills assets/page.html with the data, the style and the scripts."""
