"""A model with an effect added or taken out: split says what is fitted and what is tried, with_and_without makes both
fits by the engine of the search, revision compares the change with the effect's neighbours (result), drop_tests leave
each effect out in turn."""
