"""A model with an effect added or removed: split chooses the data for the fit and for its validation, with_and_without
makes both fits with the engine of the search, revision compares the change with the effect's neighbours (result),
drop_tests leaves each effect out in turn."""
