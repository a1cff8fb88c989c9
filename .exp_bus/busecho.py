import asyncio,sys,gc
from drivers.bus import Bus, BusGroup
async def main():
    n=int(sys.argv[1])
    b=Bus.open("socketcan:vcan0")
    g=BusGroup([b])
    def f(frames):
        for x in frames:
            if x.can_id==0x38A:
                for i in range(n): g.send(0,0x201+i,b"123456",x.timestamp_ns)
    g.start(f,print); gc.freeze()
    await asyncio.Event().wait()
asyncio.run(main())
