"""The cube that balances on its edge by a reaction wheel: its vehicle file, controller, and way of getting up and
down."""
