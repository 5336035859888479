"""Settings of JAX for a program or a call, and a cache of traced programs."""
