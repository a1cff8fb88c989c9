"""The library behind `import upright`: what a script and a notebook call, and what they get back."""
