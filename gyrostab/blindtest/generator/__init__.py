"""Generator of recordings that shares no physics with the diagnosis."""
