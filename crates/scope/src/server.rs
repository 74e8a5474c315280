//! The listener: axum on a runtime of one thread, with a bound for everything that a client can make it hold.

use std::collections::VecDeque;
use std::convert::Infallible;
use std::fmt;
use std::io;
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use axum::Router;
use axum::extract::ws::WebSocketUpgrade;
use axum::extract::{Extension, Path, Request, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use nix::sys::socket::{setsockopt, sockopt};
use thiserror::Error;
use tokio::net::TcpStream;
use tokio::sync::{Semaphore, broadcast, oneshot, watch};
use tokio::task::AbortHandle;
use tokio::time::timeout;

use super::assets;
use super::client::{self, Hub, MOST_BYTES};
use super::feed::{Control, Feed, Source};
use super::rules::{PROTOCOL, Refusal, Rules};
use fieldbeat_core::rt::confine::{self, serve_only};
use fieldbeat_core::rt::host;
use fieldbeat_core::rt::thread::file_thread;
use fieldbeat_record::metrics::{Address, remedy};

/// Browsers at a time.
const MOST_CLIENTS: usize = 32;

/// Connections that are not yet, or never will be, those of a browser that watches. For a further one the oldest goes
/// that has not said what it wants.
const MOST_CONNECTIONS: usize = 512;

/// Updates that wait for a slow browser: with fifty batches a second those of two seconds.
const ROOM: usize = 128;

/// The bytes that the kernel keeps for a slow browser: a queue of megabytes would delay all that it shows.
const SEND_BUFFER: usize = 256 << 10;

/// A request has so long to arrive, and so long to be answered.
const PATIENCE: Duration = Duration::from_secs(5);

/// Bytes and header lines of a request.
const MOST_HEAD: usize = 16 << 10;
const MOST_HEADERS: usize = 64;

/// The answer where no connection is left.
const BUSY: &[u8] = b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n";

/// Why there is no page. The message ends with the remedy.
#[derive(Error)]
pub enum ScopeError {
    /// The address is not to be had.
    #[error("scope address {address}: {error}; {}", remedy(.error))]
    Bind {
        /// The address.
        address: SocketAddr,
        /// The error of the operating system.
        error: io::Error,
    },
    /// No thread, or no runtime.
    #[error(
        "cannot start a thread for the scope: {0}; raise the limits of processes and memory (ulimit -u, \
         ulimit -v)"
    )]
    Thread(io::Error),
}
fieldbeat_core::debug_as_display!(ScopeError);

/// An address that is ours.
pub struct Endpoint {
    listener: TcpListener,
    address: SocketAddr,
    rules: Rules,
    control: Option<Arc<dyn Control>>,
}

impl fmt::Debug for Endpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Endpoint").field("address", &self.address).finish_non_exhaustive()
    }
}

impl Endpoint {
    /// Takes the address; whoever connects waits until it is served. With `control` the page may command the machine.
    pub fn bind(address: Address, control: Option<Arc<dyn Control>>) -> Result<Endpoint, ScopeError> {
        let Address { socket: address, name } = address;
        let failed = |error| ScopeError::Bind { address, error };
        let listener = TcpListener::bind(address).map_err(failed)?;
        listener.set_nonblocking(true).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        let rules = Rules::new(address, name, control.is_some()).map_err(failed)?;
        Ok(Endpoint { listener, address, rules, control })
    }

    /// Whether the page may command the machine.
    pub fn has_control(&self) -> bool {
        self.control.is_some()
    }

    /// The address, with the port that the kernel chose for port 0.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// The address that a browser opens; with the token, where one is required. All addresses of this computer go by
    /// its name.
    pub fn url(&self) -> String {
        let fragment = self.rules.fragment();
        match host::name().filter(|_| self.address.ip().is_unspecified()) {
            Some(name) => format!("http://{name}:{}/{fragment}", self.address.port()),
            None => format!("http://{}/{fragment}", self.address),
        }
    }

    /// Serves the page of the machine behind `source`, on threads that leave the core of a loop in this process alone.
    pub fn serve(self, source: impl Source, core_of_loop: Option<usize>) -> Result<Server, ScopeError> {
        let (updates, _) = broadcast::channel(ROOM);
        let (state, first) = watch::channel(r#"{"waiting":"looking for the master"}"#.into());
        let feed = Feed { updates: updates.clone(), state };
        let app = App {
            rules: Arc::new(self.rules),
            hub: Arc::new(Hub { updates, state: first, control: self.control }),
            seats: Arc::new(Semaphore::new(MOST_CLIENTS)),
        };
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
        let runtime = runtime.map_err(ScopeError::Thread)?;
        let (end, ended) = oneshot::channel();
        let ending = Arc::new(AtomicBool::new(false));
        let feeding = Arc::clone(&ending);
        let mut server = Server { ending, end: Some(end), threads: Vec::new() };
        server.start("fb-scope-feed", core_of_loop, move || feed.run(source, &feeding))?;
        let listener = self.listener;
        server.start("fb-scope", core_of_loop, move || {
            // What is under way ends with the runtime.
            runtime.block_on(async {
                tokio::select! {
                    _ = listen(listener, app) => {}
                    _ = ended => {}
                }
            });
        })?;
        Ok(server)
    }
}

/// A page that is served. Dropped, it is closed.
#[derive(Debug)]
pub struct Server {
    ending: Arc<AtomicBool>,
    end: Option<oneshot::Sender<()>>,
    threads: Vec<JoinHandle<()>>,
}

impl Server {
    fn start(
        &mut self,
        name: &str,
        core_of_loop: Option<usize>,
        work: impl FnOnce() + Send + 'static,
    ) -> Result<(), ScopeError> {
        let work = move || {
            // Root looks at the masters of all users.
            file_thread(core_of_loop);
            // Without filters the page is served all the same; the start and the doctor say so.
            let _ = serve_only(confine::Server::Scope);
            work();
        };
        let thread = std::thread::Builder::new().name(name.into()).spawn(work).map_err(ScopeError::Thread)?;
        self.threads.push(thread);
        Ok(())
    }

    /// Whether one of its threads has ended: by an error of ours.
    pub fn has_failed(&self) -> bool {
        self.threads.iter().any(JoinHandle::is_finished)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.ending.store(true, Ordering::Release);
        // Without a receiver it has ended before.
        let _ = self.end.take().map(|end| end.send(()));
        self.threads.drain(..).for_each(|thread| drop(thread.join()));
    }
}

#[derive(Clone)]
struct App {
    rules: Arc<Rules>,
    hub: Arc<Hub>,
    seats: Arc<Semaphore>,
}

/// A connection: what serves it, and whether it has said what it wants.
struct Connection {
    task: AbortHandle,
    has_requested: Arc<AtomicBool>,
}

/// The connection of a request.
#[derive(Clone)]
struct Origin {
    local: SocketAddr,
    has_requested: Arc<AtomicBool>,
}

/// Makes room for one more, if there is none. False: all of them are being answered.
fn make_room(connections: &mut VecDeque<Connection>) -> bool {
    if connections.len() >= MOST_CONNECTIONS {
        connections.retain(|one| !one.task.is_finished());
    }
    if connections.len() < MOST_CONNECTIONS {
        return true;
    }
    let silent = connections.iter().position(|one| !one.has_requested.load(Ordering::Relaxed));
    silent.and_then(|oldest| connections.remove(oldest)).map(|one| one.task.abort()).is_some()
}

async fn listen(listener: TcpListener, app: App) -> io::Result<Infallible> {
    let listener = tokio::net::TcpListener::from_std(listener)?;
    let mut connections = VecDeque::with_capacity(MOST_CONNECTIONS);
    let router = Router::new()
        .route("/", get(|| asset(Path(String::new()))))
        .route("/access", get(access))
        .route("/ws", get(watch))
        .route("/{name}", get(asset))
        .layer(from_fn_with_state(app.clone(), guard))
        .with_state(app);
    loop {
        let Ok((stream, _)) = listener.accept().await else {
            // No descriptor is left for it: later there may be one.
            tokio::time::sleep(Duration::from_millis(50)).await;
            continue;
        };
        if !make_room(&mut connections) {
            // Whoever has not read it by now does without.
            let _ = stream.try_write(BUSY);
            continue;
        }
        let Ok(local) = stream.local_addr() else { continue };
        let has_requested = Arc::<AtomicBool>::default();
        let origin = Origin { local, has_requested: Arc::clone(&has_requested) };
        let service = router.clone().layer(Extension(origin));
        let task = tokio::spawn(connection(stream, service)).abort_handle();
        connections.push_back(Connection { task, has_requested });
        // Before the next one is accepted: most have sent their request by now, and are not silent any more.
        tokio::task::yield_now().await;
    }
}

/// One request; a browser that watches goes on as a task of its own.
async fn connection(stream: TcpStream, service: Router) {
    // A hint: without it a slow browser has more in its queue.
    let _ = setsockopt(&stream, sockopt::SndBuf, &SEND_BUFFER);
    let _ = stream.set_nodelay(true);
    let serving = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(PATIENCE)
        .max_buf_size(MOST_HEAD)
        .max_headers(MOST_HEADERS)
        .keep_alive(false)
        .serve_connection(TokioIo::new(stream), TowerToHyperService::new(service))
        .with_upgrades();
    // Whoever is too slow, or sends nonsense, is not answered any further.
    let _ = timeout(2 * PATIENCE, serving).await;
}

/// Lets in whom the rules let in, and says to the browser what the page may load.
async fn guard(
    State(app): State<App>,
    Extension(origin): Extension<Origin>,
    request: Request,
    next: Next,
) -> Response {
    origin.has_requested.store(true, Ordering::Relaxed);
    let (head, body) = request.into_parts();
    let mut response = match app.rules.judge(&head, origin.local) {
        Err(refusal) => refuse(refusal),
        Ok(()) => next.run(Request::from_parts(head, body)).await,
    };
    let headers = response.headers_mut();
    for (name, value) in [
        (
            header::CONTENT_SECURITY_POLICY,
            "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; \
             base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
        ),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::CACHE_CONTROL, "no-cache"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    response
}

async fn asset(Path(name): Path<String>) -> Response {
    match assets::find(&name) {
        Some((kind, bytes)) => ([(header::CONTENT_TYPE, kind)], bytes).into_response(),
        None => (StatusCode::NOT_FOUND, "no such file; the page is at /\n").into_response(),
    }
}

fn refuse((status, why): Refusal) -> Response {
    (status, format!("{why}\n")).into_response()
}

fn all_taken() -> Response {
    let why = format!("{MOST_CLIENTS} browsers watch already: close one of them\n");
    (StatusCode::SERVICE_UNAVAILABLE, why).into_response()
}

/// Why a page gets no websocket: a browser does not say it to the page.
async fn access(State(app): State<App>, headers: HeaderMap) -> Response {
    match app.rules.judge_token(&headers) {
        Err(refusal) => refuse(refusal),
        Ok(()) if app.seats.available_permits() == 0 => all_taken(),
        Ok(()) => StatusCode::NO_CONTENT.into_response(),
    }
}

async fn watch(State(app): State<App>, headers: HeaderMap, upgrade: WebSocketUpgrade) -> Response {
    if let Err(refusal) = app.rules.judge_socket(&headers) {
        return refuse(refusal);
    }
    let Ok(seat) = Arc::clone(&app.seats).try_acquire_owned() else { return all_taken() };
    let upgrade = upgrade.protocols([PROTOCOL]).max_message_size(MOST_BYTES).max_frame_size(MOST_BYTES);
    upgrade.on_upgrade(move |socket| async move {
        let _seat = seat;
        client::serve(socket, app.hub).await;
    })
}
