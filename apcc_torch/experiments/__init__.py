"""One module an experiment: settings in, a folder of results out. The programs call these; so can a notebook."""
