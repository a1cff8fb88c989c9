"""A model with an effect added or taken out: split says what is fitted and what is tried, revision fits both models and
holds the change against the effect's neighbours (result), drop_tests leave each effect out in turn."""
