"""A stand-in for gaussian-splatting-lightning: the classes that a density controller uses, without lightning, on a CPU."""
