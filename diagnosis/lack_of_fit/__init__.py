"""What no effect explains: floor is what a right model leaves; where_it_fails looks at the rest by time, frequency,
state and equation, shapes at forces of any form, colour at random signals, events at what happened once; adequacy
decides."""
