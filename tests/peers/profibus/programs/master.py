"""pyprofibus as a master, told by lines what to do.

    master.py PORT OWN IDENT WATCHDOG-10-MS SLAVE...

A master at address OWN. Each SLAVE is ADDRESS:USER_PRM:CONFIGURATION:OUTPUTS:INPUTS, bytes as hexadecimal digits,
lengths in bytes. Its line `running` is answered when all slaves exchange data; `exchange ADDRESS OUTPUTS` gives a slave
these outputs from now on, and is answered with its inputs behind them. Each answer begins with `ok`. A mistake ends it.
"""

import queue
import sys
import threading
import time

from pyprofibus.dp import DpCfgDataElement, DpTelegram_GlobalControl, DpTelegram_SetPrm_Req
from pyprofibus.dp_master import DPM1, DpSlaveDesc
from pyprofibus.fdl import FdlFCB, FdlTelegram
from pyprofibus.phy_serial import CpPhySerial

# By this it decides how long a request without an answer keeps the wire: slow, for a busy computer. A pseudo-terminal
# takes any.
RATE = 19_200
# The outputs of a slave are new in the first answer behind them, or in the second one if they came while one was under
# way.
ANSWERS = 3


class Slave:
    def __init__(self, text, ident, watchdog):
        address, user, configuration, outputs, inputs = text.split(":")
        self.described = described = DpSlaveDesc()
        described.slaveAddr = int(address)
        # As the slave sees them.
        described.inputSize, described.outputSize = int(outputs), int(inputs)
        described.setPrmTelegram.da = described.chkCfgTelegram.da = int(address)
        parameters = described.setPrmTelegram
        parameters.identNumber = ident
        parameters.minTSDR = 11
        # Its own way of finding the factors has them the other way round.
        parameters.stationStatus |= DpTelegram_SetPrm_Req.STA_WD
        parameters.wdFact1, parameters.wdFact2 = watchdog
        described.setUserPrmData(bytes.fromhex(user))
        described.setCfgDataElements([DpCfgDataElement(byte) for byte in bytes.fromhex(configuration)])
        self.outputs, self.inputs, self.answers = bytes(described.inputSize), b"", 0


class Master:
    def __init__(self, port, own, ident, watchdog, *slaves):
        phy = CpPhySerial(port=port)
        phy.setConfig(baudrate=RATE)
        self.own = int(own)
        self.master = DPM1(phy, self.own)
        factors = next((one, -(-int(watchdog) // one)) for one in range(1, 256) if -(-int(watchdog) // one) < 256)
        self.slaves = {}
        for text in slaves:
            slave = Slave(text, int(ident), factors)
            self.slaves[slave.described.slaveAddr] = slave
            self.master.addSlave(slave.described)
        self.master.initialize()
        self.operates = False

    def step(self):
        described = self.master.run()
        slave = self.slaves[described.slaveAddr] if described else None
        if slave:
            inputs = described.getMasterInData()
            if inputs is not None:
                slave.inputs = bytes(inputs)
                slave.answers += 1
            described.setMasterOutData(slave.outputs)
        if not self.operates and self.are_running():
            # It never says by itself that outputs count.
            control = DpTelegram_GlobalControl(da=FdlTelegram.ADDRESS_MCAST, sa=self.own)
            self.master.dpTrans.send(fcb=FdlFCB(), telegram=control)
            self.operates = True
        time.sleep(0.0002)

    def are_running(self):
        return all(slave.described.isConnected() and slave.answers for slave in self.slaves.values())

    def obey(self, line):
        match line.split():
            case ["running"]:
                while not self.are_running():
                    self.step()
                return "ok"
            case ["exchange", address, outputs]:
                slave = self.slaves[int(address)]
                slave.outputs, begun = bytes.fromhex(outputs), slave.answers
                while slave.answers < begun + ANSWERS:
                    self.step()
                return f"ok {slave.inputs.hex()}"
        raise ValueError(line)


def main():
    # The package prints what it sees to standard output.
    out, sys.stdout = sys.stdout, sys.stderr
    master, lines = Master(*sys.argv[1:]), queue.SimpleQueue()

    def read():
        for line in sys.stdin:
            lines.put(line)
        lines.put(None)

    threading.Thread(target=read, daemon=True).start()
    print("ready", file=out, flush=True)
    while True:
        try:
            line = lines.get_nowait()
        except queue.Empty:
            master.step()
            continue
        if line is None:
            return
        print(master.obey(line), file=out, flush=True)


main()
