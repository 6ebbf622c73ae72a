"""Test damaged and hostile inputs: exit code 0 or 2, soon and in bounded memory."""
