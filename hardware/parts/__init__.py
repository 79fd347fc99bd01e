"""The printed parts of a head, as models that follow `hardware/optics.toml`."""
