//! A debugger's hold on a thread: it neither runs nor waits to run, and its scheduler does not know why.

use libc::pid_t;

/// A thread under the control of the calling thread, for as long as that lives.
pub struct Hold(pid_t);

impl Hold {
    /// Takes control; the thread goes on.
    pub fn seize(tid: pid_t) -> Hold {
        let hold = Hold(tid);
        hold.ask(libc::PTRACE_SEIZE);
        hold
    }

    /// Stops it, and waits until it stands.
    pub fn stop(&self) {
        self.ask(libc::PTRACE_INTERRUPT);
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
        let none = std::ptr::null_mut::<u8>();
        // SAFETY: none of these requests reads or writes memory.
        let result = unsafe { libc::ptrace(request, self.0, none, none) };
        assert_eq!(result, 0, "{}", std::io::Error::last_os_error());
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
