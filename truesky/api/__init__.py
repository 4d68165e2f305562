"""Python interface: open a lake (folder with tables and images), and check and run requests for simulations."""
