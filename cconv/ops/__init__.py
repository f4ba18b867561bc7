"""Array operations behind the layers in `cconv.nn`."""
