"""The blind proof of the diagnosis: cases of concealed physics, sealed, and the scorer.

The truth here is written from the equations by an author of its own. It shares no physics with the
simulator that is diagnosed: `pup.blind` imports nothing of `pup.physics`, and nothing below it
imports `pup.blind`.
"""
