"""A Modbus TCP server of pymodbus with one register for each address, told by lines what they hold.

    server.py ADDRESS PORT [no-read-write] [unit-1]

    set ADDRESS VALUE...    ok
    get ADDRESS COUNT       ok VALUE...
    counts                  ok TOTAL FC3 FC6 FC16 FC23

With unit-1 it has no other unit.
"""

import asyncio
import sys
from collections import Counter

from pymodbus.pdu import ExceptionResponse
from pymodbus.pdu.register_message import ReadWriteMultipleRegistersRequest
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

REGISTERS = 0x7000
counts = Counter()


class Refused(ReadWriteMultipleRegistersRequest):
    """Function 23 as of a server that does not know it."""

    async def datastore_update(self, context, device_id):
        return ExceptionResponse(self.function_code, 1)


def count(sending, pdu):
    if not sending:
        counts[pdu.function_code] += 1
    return pdu


async def answer(server, unit, line):
    command, *words = line.split()
    numbers = [int(word, 0) for word in words]
    if command == "counts":
        return [counts.total()] + [counts[function] for function in (3, 6, 16, 23)]
    if command == "get":
        return await server.async_getValues(unit, 3, numbers[0], numbers[1])
    await server.async_setValues(unit, 16, numbers[0], numbers[1:])
    return []


async def main():
    # Unit 0 are all of them.
    unit = 1 if "unit-1" in sys.argv else 0
    server = ModbusTcpServer(
        SimDevice(unit, simdata=[SimData(0, count=REGISTERS, values=0, datatype=DataType.REGISTERS)]),
        address=(sys.argv[1], int(sys.argv[2])),
        trace_pdu=count,
        custom_pdu=[Refused] if "no-read-write" in sys.argv else None,
    )
    await server.serve_forever(background=True)
    print("ready", flush=True)
    while line := await asyncio.to_thread(sys.stdin.readline):
        print("ok", *await answer(server, unit, line), flush=True)
    await server.shutdown()


asyncio.run(main())
