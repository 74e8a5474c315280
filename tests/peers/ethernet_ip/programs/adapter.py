"""A class 1 adapter made of cm-ethernetip, with the assemblies of a MOONS' drive: adapter.py ADDRESS.

It answers each line on standard input by one. "error ..." is an exception of Python.

    inputs NUMBER...       from here on the input assembly begins with these 32-bit numbers
    outputs COUNT          the output assembly as it came last: so many 32-bit numbers
    packets                how many came, and how many of those had another size, no run, or not the next sequence count
    opened                 the connection serial numbers of all opens so far, and how many connections are open
"""

import asyncio
import sys

from ethernetip.cip.identity_info import IdentityInfo
from ethernetip.device.virtual_device import VirtualDevice

INPUTS, OUTPUTS, CONFIGURATION = 0x65, 0x70, 0x66
# Sequence count, run/idle, assembly.
SIZE = 2 + 4 + 64


def signed(data):
    return int.from_bytes(data, "little", signed=True)


class Adapter:
    def __init__(self, address):
        identity = IdentityInfo(vendor_id=60, device_type=43, product_code=176, product_name="an adapter")
        self.device = VirtualDevice(identity, bind_address=address)
        for instance, size in ((INPUTS, 56), (OUTPUTS, 64), (CONFIGURATION, 2)):
            self.device.add_assembly(instance, size)
        self.serials = []
        self.last = {}
        self.packets = [0, 0, 0, 0]
        manager = self.device.connection_manager
        manager.on_connection_established.append(self.opened)

    async def start(self):
        await self.device.start()
        self.device._udp.on_data_received.append(self.received)
        # Without it a message on a connection is answered by the id of the request, not by that of the originator.
        self.device._adapter.connection_id_lookup = self.reply_id

    def reply_id(self, outgoing):
        connection = self.device.connection_manager.find_by_ot_id(outgoing)
        return connection and connection.to_connection_id

    def opened(self, connection):
        self.serials.append(connection.connection_serial_number)

    def received(self, connection, data):
        count = int.from_bytes(data[:2], "little")
        before = self.last.get(connection)
        self.last[connection] = count
        is_next = before is None or count == (before + 1) & 0xFFFF
        found = (True, len(data) != SIZE, not data[2] & 1, not is_next)
        self.packets = [sum(pair) for pair in zip(self.packets, found)]

    def answer(self, words):
        what, *numbers = words
        assemblies = self.device.assemblies
        if what == "inputs":
            data = b"".join(int(number).to_bytes(4, "little", signed=True) for number in numbers)
            assemblies.get_assembly(INPUTS).write_bytes(0, data)
            return []
        if what == "outputs":
            data = assemblies.get_assembly(OUTPUTS).get_data()
            return [signed(data[4 * n : 4 * n + 4]) for n in range(int(numbers[0]))]
        if what == "packets":
            return self.packets
        if what == "opened":
            return [*self.serials, len(self.device.connection_manager.active_connections)]
        raise ValueError(what)


async def main():
    adapter = Adapter(sys.argv[1])
    await adapter.start()
    print("ready", flush=True)
    lines = asyncio.StreamReader()
    loop = asyncio.get_running_loop()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(lines), sys.stdin)
    while line := await lines.readline():
        try:
            print("ok", *adapter.answer(line.decode().split()), flush=True)
        except Exception as error:
            print("error", repr(error), flush=True)


asyncio.run(main())
