"""The line experiment on files: known poses, true segments and what a camera saw of them."""
