"""A viewer for live_viewers.py: PORT subscribed|idle. It connects, and counts what comes until its input ends.

A subscribed one gets every cycle, an idle one nothing.
"""

from __future__ import annotations

import asyncio
import json
import sys

from websockets.asyncio.client import connect


async def view(port: int, kind: str) -> None:
    over = asyncio.get_running_loop().run_in_executor(None, sys.stdin.read)
    address, protocols = f"ws://127.0.0.1:{port}", ["foxglove.sdk.v1"]
    async with connect(address, subprotocols=protocols, max_queue=None) as server:  # type: ignore[arg-type]
        while (message := json.loads(await server.recv()))["op"] != "advertise":
            pass
        (channel,) = (each["id"] for each in message["channels"] if each["topic"] == "/vehicle")
        if kind == "subscribed":
            await server.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": channel, "channelId": channel}]}))
        print("ready", flush=True)
        stamps = []
        while kind == "subscribed" and not over.done():
            stamps.append(int.from_bytes((await server.recv())[5:13], "little"))
        await over
    print((len(stamps) - 1) / (stamps[-1] - stamps[0]) * 1e9 if stamps else 0.0)


if __name__ == "__main__":
    asyncio.run(view(int(sys.argv[1]), sys.argv[2]))
