"""Measurements that stand behind numbers in the documentation; each module is one command."""
