"""The public shape of gaussian-splatting-lightning, as far as a density controller meets it; without lightning, on a CPU."""
