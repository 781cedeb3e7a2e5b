"""Density controllers: each is a dataclass of settings that builds a module with hooks around backward."""
