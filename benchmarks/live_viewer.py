"""A viewer for live_viewers.py: subscribes to every cycle at PORT, says so, and counts until its input ends."""

from __future__ import annotations

import asyncio
import json
import sys

from websockets.asyncio.client import connect


async def view(port: int) -> None:
    over = asyncio.get_running_loop().run_in_executor(None, sys.stdin.read)
    address, protocols = f"ws://127.0.0.1:{port}", ["foxglove.sdk.v1"]
    async with connect(address, subprotocols=protocols, max_queue=None) as server:  # type: ignore[arg-type]
        while (message := json.loads(await server.recv()))["op"] != "advertise":
            pass
        (channel,) = (each["id"] for each in message["channels"] if each["topic"] == "/vehicle")
        await server.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": channel, "channelId": channel}]}))
        print("subscribed", flush=True)
        stamps = []
        while not over.done():
            stamps.append(int.from_bytes((await server.recv())[5:13], "little"))
    print(json.dumps({"messages": len(stamps), "seconds": (stamps[-1] - stamps[0]) * 1e-9}))


if __name__ == "__main__":
    asyncio.run(view(int(sys.argv[1])))
