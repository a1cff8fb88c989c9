"""The monorail vehicle held up by gyroscopes: its vehicle file, controller, and way of getting up and down."""
