"""Resting, for both clients."""

import time

import anyio

sleep = time.sleep
wait = anyio.sleep
