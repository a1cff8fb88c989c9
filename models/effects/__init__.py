"""The effects that a model may lack, one file a family; catalogue has them all. Importing it computes nothing."""
