"""What people look at after a run: pages, tables, notebooks and the user study."""
