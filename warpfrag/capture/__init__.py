"""Scene to fragments: the dynamic fragment buffer (count, prefix sum, store, sort), then shading."""
