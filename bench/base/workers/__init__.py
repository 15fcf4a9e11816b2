"""Tasks on all cores of a machine, in processes that live until the last; or one after another in this process."""
