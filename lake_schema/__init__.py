"""What is declared: tables, columns, units, the sky, the mission database, and how the lake keeps them."""

__version__ = "0.1.0"
