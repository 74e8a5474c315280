//! One browser: what it shows, what it gets of it, and how much it is let send. What it sends is taken while what it
//! gets waits for it: a stop does not wait for a browser that reads slowly.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::extract::ws::{CloseFrame, Message, Utf8Bytes, WebSocket, close_code};
use futures_util::stream::{SplitSink, SplitStream};
use futures_util::{SinkExt, StreamExt};
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::sync::broadcast::error::RecvError;
use tokio::sync::{broadcast, mpsc, watch};
use tokio::time::timeout;

use super::feed::{Control, Update};
use super::frame::Shown;
use super::operate::Operation;
use fieldbeat_control as control;

/// Bytes of a message of the page: a list of some hundred numbers.
pub const MOST_BYTES: usize = 16 << 10;

/// Messages that a browser may send at once, and in a second on and on.
const BURST: f64 = 100.0;
const RATE: f64 = 20.0;

/// Answers that a browser has not read yet.
const MOST_ANSWERS: usize = 32;

/// A browser that takes nothing for so long makes room for another one.
const PATIENCE: Duration = Duration::from_secs(60);

/// The requests of a page.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
enum PageRequest {
    /// The numbers of the signals that it shows from now on.
    Show(Vec<usize>),
    /// A request to the axes.
    Operate(control::Request),
}

/// The state that every browser is served from.
pub struct Hub {
    /// The updates.
    pub updates: broadcast::Sender<Update>,
    /// The state that has to be known first.
    pub state: watch::Receiver<Utf8Bytes>,
    /// Where commands go, if they are allowed.
    pub control: Option<Arc<dyn Control>>,
}

/// Why a browser is served no longer.
enum End {
    /// It is gone, or the server ends.
    Gone,
    /// It did what no page of ours does.
    Misuse(&'static str),
}

/// Serves one browser up to its end.
pub async fn serve(socket: WebSocket, hub: Arc<Hub>) {
    let (mut sink, stream) = socket.split();
    let (show, shown) = watch::channel(Shown::default());
    let (answer, answers) = mpsc::channel(MOST_ANSWERS);
    let updates = hub.updates.subscribe();
    let mut operation = Operation::new(hub.control.clone());
    let receiver = Receiver { stream, show, answer, operation: &mut operation };
    let sender = Sender { sink: &mut sink, shown, answers, updates, lost: 0 };
    let end = tokio::select! {
        end = receiver.run() => end,
        end = sender.run(&hub) => end,
    };
    operation.finish().await;
    if let Err(End::Misuse(why)) = end {
        let close = CloseFrame { code: close_code::POLICY, reason: why.into() };
        // Whoever floods may not read it.
        let _ = timeout(Duration::from_secs(1), sink.send(Message::Close(Some(close)))).await;
    }
}

/// The receiver of a browser's requests. Nothing here waits for what it reads.
struct Receiver<'a> {
    stream: SplitStream<WebSocket>,
    show: watch::Sender<Shown>,
    answer: mpsc::Sender<Value>,
    operation: &'a mut Operation,
}

impl Receiver<'_> {
    async fn run(mut self) -> Result<Infallible, End> {
        let mut allowance = Allowance::new(Instant::now());
        loop {
            tokio::select! {
                answer = self.operation.answer() => {
                    self.answer.try_send(answer).map_err(|_| End::Misuse("answers are not read"))?;
                }
                message = self.stream.next() => {
                    let message = message.and_then(Result::ok).ok_or(End::Gone)?;
                    if !allowance.take(Instant::now()) {
                        return Err(End::Misuse("too many messages"));
                    }
                    match message {
                        Message::Text(text) => self.request(&text)?,
                        Message::Binary(_) => return Err(End::Misuse("messages are text")),
                        Message::Ping(_) | Message::Pong(_) => {}
                        Message::Close(_) => return Err(End::Gone),
                    }
                }
            }
        }
    }

    fn request(&mut self, text: &str) -> Result<(), End> {
        match serde_json::from_str(text) {
            Ok(PageRequest::Show(signals)) => drop(self.show.send_replace(Shown::new(signals))),
            Ok(PageRequest::Operate(request)) => self.operation.request(request).map_err(End::Misuse)?,
            Err(_) => return Err(End::Misuse("unknown message: reload the page")),
        }
        Ok(())
    }
}

/// The sender to a browser.
struct Sender<'a> {
    sink: &'a mut SplitSink<WebSocket, Message>,
    shown: watch::Receiver<Shown>,
    answers: mpsc::Receiver<Value>,
    updates: broadcast::Receiver<Update>,
    /// Updates that it was too slow for.
    lost: u64,
}

impl Sender<'_> {
    async fn run(mut self, hub: &Hub) -> Result<Infallible, End> {
        self.say(&json!({ "control": hub.control.is_some() })).await?;
        let first = hub.state.borrow().clone();
        self.send(Message::Text(first)).await?;
        loop {
            tokio::select! {
                biased;
                answer = self.answers.recv() => {
                    let answer = answer.ok_or(End::Gone)?;
                    self.say(&json!({ "operated": answer })).await?;
                }
                update = self.updates.recv() => match update {
                    Ok(Update::Text(text)) => self.send(Message::Text(text)).await?,
                    Ok(Update::Samples(block, period_s)) => {
                        let frame = self.shown.borrow().frame(&block, period_s);
                        if let Some(frame) = frame {
                            self.send(Message::Binary(frame.into())).await?;
                        }
                    }
                    Err(RecvError::Lagged(missed)) => {
                        self.lost += missed;
                        // What it missed may have been another machine.
                        let state = hub.state.borrow().clone();
                        self.send(Message::Text(state)).await?;
                        self.say(&json!({ "frames_lost": self.lost })).await?;
                    }
                    Err(RecvError::Closed) => return Err(End::Gone),
                },
            }
        }
    }

    async fn say(&mut self, message: &Value) -> Result<(), End> {
        self.send(Message::Text(message.to_string().into())).await
    }

    async fn send(&mut self, message: Message) -> Result<(), End> {
        match timeout(PATIENCE, self.sink.send(message)).await {
            Ok(Ok(())) => Ok(()),
            _ => Err(End::Gone),
        }
    }
}

/// How many messages are still taken.
#[derive(Debug)]
struct Allowance {
    left: f64,
    at: Instant,
}

impl Allowance {
    fn new(now: Instant) -> Allowance {
        Allowance { left: BURST, at: now }
    }

    /// Takes one; false: there is none left.
    fn take(&mut self, now: Instant) -> bool {
        let passed = now.saturating_duration_since(self.at).as_secs_f64();
        self.at = now;
        self.left = (self.left + passed * RATE).min(BURST);
        let is_left = self.left >= 1.0;
        if is_left {
            self.left -= 1.0;
        }
        is_left
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_uses_its_allowance_up_and_a_page_does_not() {
        let begin = Instant::now();
        let mut allowance = Allowance::new(begin);
        assert_eq!((0..1_000).filter(|_| allowance.take(begin)).count(), BURST as usize);
        let mut now = begin;
        for _ in 0..1_000 {
            now += Duration::from_millis(51);
            assert!(allowance.take(now));
        }
        // Whoever was silent for an hour has no more than anybody else.
        now += Duration::from_secs(3600);
        assert_eq!((0..1_000).filter(|_| allowance.take(now)).count(), BURST as usize);
    }
}
