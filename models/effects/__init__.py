"""The effects that a model may lack, one file per family; `catalogue` lists them all. Importing it computes nothing."""
