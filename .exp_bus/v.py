import sys,socket,struct,select,asyncio
mode=sys.argv[1]
bus=socket.socket(socket.AF_CAN,socket.SOCK_RAW,socket.CAN_RAW)
if 'f' in mode: bus.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, struct.pack("=II", 0x38A, 0xC000_07FF))
bus.bind(("vcan0",))
sp=struct.pack("=IB3x8s",0x201,6,bytes(8))
def got(d):
    if d[0]==0x8A and d[1]==3: bus.send(sp)
if mode[0]=='A':
    while True: got(bus.recv(16))
if mode[0]=='B':
    bus.setblocking(False); e=select.epoll(); e.register(bus.fileno(),select.EPOLLIN)
    while True:
        e.poll(); got(bus.recv(16))
if mode[0]=='C':
    bus.setblocking(False)
    async def main():
        asyncio.get_running_loop().add_reader(bus.fileno(),lambda: got(bus.recv(16)))
        await asyncio.Event().wait()
    asyncio.run(main())
if mode[0]=='D':
    from drivers.socketcan import SocketcanPort
    class H: socket=bus
    p=SocketcanPort(H,"vcan0",0); e=select.epoll(); e.register(bus.fileno(),select.EPOLLIN)
    while True:
        e.poll()
        for f in p.receive():
            if f.can_id==0x38A: p.send(0x201,b"123456",0)
