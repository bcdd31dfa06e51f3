"""The nodes; each module's `main` is an executable."""
