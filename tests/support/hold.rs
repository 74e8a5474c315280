//! A debugger's hold on a thread: it neither runs nor waits to run, and its scheduler does not know why.

use libc::pid_t;

/// A thread under the control of the calling thread, for as long as that lives.
pub struct Hold(pid_t);

impl Hold {
    /// Takes control; the thread goes on.
    pub fn seize(tid: pid_t) -> Hold {
        let hold = Hold(tid);
        // Stops at system calls differ from others.
        hold.request(libc::PTRACE_SEIZE, 0, libc::PTRACE_O_TRACESYSGOOD as usize);
        hold
    }

    /// Stops it, and waits until it stands.
    pub fn stop(&self) {
        self.ask(libc::PTRACE_INTERRUPT);
        self.await_stop();
    }

    /// Stops it where it is about to make this system call: all that it has decided before that stands.
    pub fn stop_before(&self, call: libc::c_long) {
        self.stop();
        while self.call_begun() != Some(call.cast_unsigned()) {
            self.ask(libc::PTRACE_SYSCALL);
            self.await_stop();
        }
    }

    /// The system call at whose begin it stands.
    fn call_begun(&self) -> Option<u64> {
        // SAFETY: all zero is a value of it.
        let mut info: libc::ptrace_syscall_info = unsafe { std::mem::zeroed() };
        self.request(libc::PTRACE_GET_SYSCALL_INFO, size_of_val(&info), (&raw mut info).addr());
        if info.op != libc::PTRACE_SYSCALL_INFO_ENTRY {
            return None;
        }
        // SAFETY: the kernel has written the part that `op` names.
        Some(unsafe { info.u.entry.nr })
    }

    fn await_stop(&self) {
        // SAFETY: a null status is allowed.
        assert_eq!(unsafe { libc::waitpid(self.0, std::ptr::null_mut(), libc::__WALL) }, self.0);
    }

    /// Lets it go on.
    pub fn go(&self) {
        self.ask(libc::PTRACE_CONT);
    }

    /// Gives it back, if it stands.
    pub fn release(self) {
        self.ask(libc::PTRACE_DETACH);
    }

    /// Waits until it has ended: as long as nobody does, neither does its process.
    pub fn await_end(self) {
        let mut status = 0;
        // SAFETY: the kernel writes one int.
        while unsafe { libc::waitpid(self.0, &raw mut status, libc::__WALL) } == self.0
            && !libc::WIFEXITED(status)
            && !libc::WIFSIGNALED(status)
        {}
    }

    fn ask(&self, request: libc::c_uint) {
        self.request(request, 0, 0);
    }

    fn request(&self, request: libc::c_uint, address: usize, data: usize) {
        // SAFETY: only the request for a system call writes memory, of which it is given the size and the place.
        let result = unsafe { libc::ptrace(request, self.0, address, data) };
        assert!(result >= 0, "{}", std::io::Error::last_os_error());
    }
}

/// The thread of this name in process `pid`.
pub fn thread(pid: u32, name: &str) -> pid_t {
    let tasks = std::fs::read_dir(format!("/proc/{pid}/task")).unwrap();
    let task = tasks
        .map(|task| task.unwrap().path())
        .find(|task| std::fs::read_to_string(task.join("comm")).is_ok_and(|comm| comm.trim() == name));
    task.unwrap().file_name().unwrap().to_str().unwrap().parse().unwrap()
}
