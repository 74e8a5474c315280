"""A class 1 scanner made of ethernetip for the assemblies of a MOONS' drive: scanner.py ADDRESS RPI_MS.

It listens at 0.0.0.0:2222, and sends from another port. It answers each line on standard input by one.

    outputs NUMBER...      from here on the output assembly begins with these 32-bit numbers
    inputs COUNT           the input assembly as it came last: so many 32-bit numbers
    packets                how many came on the connection, and how many of those had another size, or did not have
                           the next sequence number
    close                  Forward_Close
"""

import os
import sys

from ethernetip import ethernetip

INPUTS, OUTPUTS, CONFIGURATION = 0x65, 0x70, 0x66
# Sequence count, assembly.
SIZE = 2 + 56

packet_of = ethernetip.UdpRecvDataPacket


class Scanner:
    def __init__(self, address, rpi_ms):
        self.packets, self.last = [0, 0, 0], None
        # What is received goes through this.
        ethernetip.UdpRecvDataPacket = self.received
        network = ethernetip.EtherNetIP(address)
        self.connection = network.explicit_conn(address)
        self.inputs = network.registerAssembly(network.ENIP_IO_TYPE_INPUT, 56, INPUTS, self.connection)
        self.outputs = network.registerAssembly(network.ENIP_IO_TYPE_OUTPUT, 64, OUTPUTS, self.connection)
        self.connection.registerSession()
        network.startIO()
        status = self.connection.sendFwdOpenReq(
            INPUTS, OUTPUTS, CONFIGURATION, torpi=rpi_ms, otrpi=rpi_ms, multiplier=3
        )
        if status != 0:
            raise ConnectionError(f"Forward_Open: {status}")
        self.connection.produce()

    def received(self, data):
        packet = packet_of(data)
        if packet.conn_id == self.connection.toconnid:
            is_next = self.last is None or packet.seq_num == (self.last + 1) % 2**32
            found = (True, packet.length != SIZE, not is_next)
            self.packets = [sum(pair) for pair in zip(self.packets, found)]
            self.last = packet.seq_num
        return packet

    def answer(self, what, *numbers):
        if what == "outputs":
            for at, number in enumerate(numbers):
                for bit in range(32):
                    self.outputs[32 * at + bit] = bool(int(number) >> bit & 1)
            return []
        if what == "inputs":
            bits = (self.inputs[32 * at : 32 * at + 32] for at in range(int(numbers[0])))
            numbers = (sum(1 << at for at, bit in enumerate(long) if bit) for long in bits)
            return [number - (number >> 31 << 32) for number in numbers]
        if what == "packets":
            return self.packets
        if what == "close":
            self.connection.stopProduce()
            # It does not look at the status of the reply.
            if self.connection.sendFwdCloseReq(INPUTS, OUTPUTS, CONFIGURATION) != 0:
                raise ConnectionError("Forward_Close: no reply")
            return []
        raise ValueError(what)


scanner = Scanner(sys.argv[1], int(sys.argv[2]))
print("ready", flush=True)
for line in sys.stdin:
    try:
        print("ok", *scanner.answer(*line.split()), flush=True)
    except Exception as error:
        print("error", repr(error), flush=True)
# Its threads do not end by themselves.
os._exit(0)
