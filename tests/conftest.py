"""What all tests share: no example of a property has a deadline, since machines and their load differ."""

from hypothesis import settings

settings.register_profile("no deadline", deadline=None)
settings.load_profile("no deadline")
