"""What is deployed: the command line and the services."""
