"""Looking at a field: how it is drawn, from where, and what it is drawn into: pictures, videos, a page, a viewer."""
