"""Public data sets: what is in a folder, as sequences that can be run and scored. One module each; `registry` has them by name."""
