"""The gateway: studies over REST, robots over ZeroMQ, in one asyncio process."""
