//! The commands of one browser: an operator of the master's axes, like a panel in a terminal, under the same rules. The
//! page has to ask again and again, or it has left, and what it left is stopped and powered off.

use std::collections::VecDeque;
use std::sync::Arc;

use serde_json::{Value, json};
use tokio::task::{JoinHandle, spawn_blocking};

use super::feed::Control;
use fieldbeat_control::{Act, OperateError, Operator, Request};

/// Requests that end a motion and wait for the answer to the one before.
const MOST_WAITING: usize = 16;

/// One browser as an operator. A request takes the time of a conversation, on another thread.
pub struct Operation {
    control: Option<Arc<dyn Control>>,
    idle: Option<Operator>,
    under_way: Option<JoinHandle<(Option<Operator>, Value)>>,
    /// The requests that follow it.
    waiting: VecDeque<Request>,
}

impl Operation {
    /// By way of `control`, if commands are allowed.
    pub fn new(control: Option<Arc<dyn Control>>) -> Operation {
        Operation { control, idle: None, under_way: None, waiting: VecDeque::new() }
    }

    /// Begins a request. While one is under way, only those that end a motion are taken: they follow it at once,
    /// whether its answer was read or not. An error says why the browser is served no longer.
    pub fn request(&mut self, request: Request) -> Result<(), &'static str> {
        if self.under_way.is_none() {
            self.begin(request);
            return Ok(());
        }
        if !matches!(request, Request::Stop | Request::StopAxis(_) | Request::Act(Act::Release { .. })) {
            return Err("a request before the answer to the one before");
        }
        if self.waiting.len() == MOST_WAITING {
            return Err("too many stops at once");
        }
        self.waiting.push_back(request);
        Ok(())
    }

    /// The browser is gone. What ends a motion, and waits, is requested all the same.
    pub async fn finish(mut self) {
        while !self.waiting.is_empty() {
            self.answer().await;
        }
    }

    fn begin(&mut self, request: Request) {
        let (control, idle) = (self.control.clone(), self.idle.take());
        self.under_way = Some(spawn_blocking(move || ask(control, idle, request)));
    }

    /// The answer to the request that is under way; it does not come where there is none.
    pub async fn answer(&mut self) -> Value {
        let Some(under_way) = &mut self.under_way else { return std::future::pending().await };
        let (operator, answer) = under_way
            .await
            .unwrap_or_else(|_| (None, json!({ "error": "internal error: please report it" })));
        (self.idle, self.under_way) = (operator, None);
        if let Some(next) = self.waiting.pop_front() {
            self.begin(next);
        }
        answer
    }
}

/// The answer to a request, and the operator for the next one.
fn ask(
    control: Option<Arc<dyn Control>>,
    idle: Option<Operator>,
    request: Request,
) -> (Option<Operator>, Value) {
    let Some(control) = control else {
        return (None, json!({ "error": "this page only looks: start `fieldbeat scope --control`" }));
    };
    let is_old = idle.is_some();
    let mut operator = match idle.map_or_else(|| control.operator(), Ok) {
        Ok(operator) => operator,
        Err(why) => return (None, json!({ "error": why })),
    };
    match operator.ask(request.clone()) {
        Ok(reply) => (Some(operator), json!({ "ok": reply })),
        // It goes on; after anything else another conversation has to be begun.
        Err(OperateError::Refused(why)) => (Some(operator), json!({ "error": why })),
        // The master ends a conversation that is silent for long, or was started again meanwhile. A stop gets through
        // all the same; what moves an axis is not repeated.
        Err(_) if is_old && !matches!(request, Request::Act(_)) => {
            drop(operator);
            ask(Some(control), None, request)
        }
        Err(error) => (None, json!({ "error": error.to_string() })),
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;
    use std::sync::mpsc::{Receiver, Sender, channel};

    use super::*;

    /// It refuses, when it is let.
    struct Slow(Mutex<Receiver<()>>);

    impl Control for Slow {
        fn operator(&self) -> Result<Operator, String> {
            self.0.lock().unwrap().recv().unwrap();
            Err("refused".to_owned())
        }
    }

    fn operation() -> (Operation, Sender<()>) {
        let (go_on, waits) = channel();
        (Operation::new(Some(Arc::new(Slow(Mutex::new(waits))))), go_on)
    }

    #[tokio::test]
    async fn what_ends_a_motion_follows_the_request_under_way_and_nothing_else_does() {
        let (mut operation, go_on) = operation();
        let state = || Request::State { since: 0 };
        assert_eq!(operation.request(state()), Ok(()));
        assert_eq!(operation.request(Request::Stop), Ok(()));
        assert_eq!(operation.request(Request::Act(Act::Release { jog: 1 })), Ok(()));
        assert!(operation.request(state()).is_err());
        assert!(operation.request(Request::Act(Act::Hold { jog: 1 })).is_err());
        for _ in 0..3 {
            go_on.send(()).unwrap();
            assert_eq!(operation.answer().await, json!({ "error": "refused" }));
        }
        // All of them have been answered, and no more.
        assert_eq!(operation.request(state()), Ok(()));
        go_on.send(()).unwrap();
        operation.answer().await;
        assert!(operation.under_way.is_none());
    }

    #[tokio::test]
    async fn a_stop_of_a_browser_that_has_gone_is_requested_all_the_same() {
        let (mut operation, go_on) = operation();
        operation.request(Request::State { since: 0 }).unwrap();
        operation.request(Request::Stop).unwrap();
        go_on.send(()).unwrap();
        operation.finish().await;
        // Only a request that has begun holds the control now: the stop. It takes this.
        go_on.send(()).unwrap();
    }

    #[tokio::test]
    async fn stops_that_wait_are_bounded() {
        let (mut operation, _go_on) = operation();
        let taken = (0..100).filter(|_| operation.request(Request::Stop).is_ok()).count();
        assert_eq!(taken, 1 + MOST_WAITING);
    }
}
