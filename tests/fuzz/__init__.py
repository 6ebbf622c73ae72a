"""Damaged and hostile inputs: whatever is in a file, the command line answers with exit code 0 or 2, soon, and in bounded memory."""
