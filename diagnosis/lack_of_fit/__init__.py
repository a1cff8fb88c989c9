"""Lack of fit, whatever the effects are called: floor gives what a correct model leaves; where_it_fails tests the rest
by time, frequency, state and equation, shapes tests forces of any form, colour random signals, events changes that
happen once; adequacy decides."""
