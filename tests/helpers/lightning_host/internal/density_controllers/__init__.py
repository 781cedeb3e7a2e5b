"""Density controllers: a dataclass of settings that makes a module with hooks around backward."""
