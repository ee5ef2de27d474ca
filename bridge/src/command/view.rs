//! `semidense-bridge view`: serves the live page, or a finished run.

use std::io::Write;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use clap::Args;
use semidense::service::child::follow_supervisor;
use semidense::service::shutdown::Shutdown;
use semidense::wire::port::{WaitError, wait};

use crate::command::{CommandResult, CommonArguments, note, number_within};
use crate::feed::{Feed, Listener, USUAL_DEPTH};
use crate::session::Wants;
use crate::web::finished::{read_run, read_summary};
use crate::web::guard::{Guard, new_token};
use crate::web::history::follow;
use crate::web::saving::Saver;
use crate::web::scene::{Scene, USUAL_POINTS};
use crate::web::server::{Server, Shown};
use crate::web::stream::StreamOptions;

/// Added to the niceness it was started with: it runs only when nothing else needs the CPU.
const NICENESS: i32 = 10;
/// Interval at which the readability of the topics is checked.
const LOOK_PERIOD: Duration = Duration::from_millis(500);

/// Serve a web page: a running instance live, or a finished run with a time slider
///
/// Live: camera image with the keyframe's depth, the growing map, the state and its reason, rates, latencies, and a
/// button that saves the map; waits for an instance, and for the next one when it ends. On the same port: /metrics for
/// Prometheus. The page loads nothing from other hosts. It is an ordinary subscriber and does not affect the pipeline.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    semidense view                          then open http://127.0.0.1:8765\n  \
    semidense view output/latest            the newest finished run\n  \
    semidense view --listen 0.0.0.0:8765    for a phone: open the address with the token that is printed\n  \
    ssh -L 8765:127.0.0.1:8765 robot        from elsewhere, without opening a port")]
pub struct ViewArguments {
    /// Folder of a finished run [default: the running instance, live]
    #[arg(value_name = "FOLDER")]
    folder: Option<PathBuf>,
    /// Address and port to serve on; for other machines, an address of this one, or 0.0.0.0 for all its addresses
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:8765")]
    listen: SocketAddr,
    /// Admit anyone who reaches the address; otherwise addresses beyond this machine require a token
    #[arg(long)]
    no_token: bool,
    /// Another name of this machine, besides localhost and IP addresses, to accept in URLs; may be repeated
    #[arg(long, value_name = "NAME")]
    host: Vec<String>,
    /// Another site whose pages may connect.
    #[arg(
        long,
        value_name = "ORIGIN",
        help = "Another site whose pages may connect, e.g. https://app.foxglove.dev; may be repeated"
    )]
    allow_origin: Vec<String>,
    /// Maximum rate of images for each page
    #[arg(long, value_name = "HZ", default_value_t = 10.0, value_parser = rate)]
    image_rate: f64,
    /// Maximum number of map points kept: 8 bytes each, here and in each page
    #[arg(long, value_name = "N", default_value_t = USUAL_POINTS, value_parser = points)]
    max_points: usize,
    /// Folder in which the save button creates a new folder for the map
    #[arg(long, value_name = "DIR", default_value = "output")]
    maps: PathBuf,
}

fn rate(text: &str) -> Result<f64, String> {
    number_within(text, 0.1..=60.0, "needs a number from 0.1 to 60")
}

fn points(text: &str) -> Result<usize, String> {
    number_within(text, 10_000..=50_000_000, "needs a number from 10000 to 50000000")
}

/// Serves until a signal arrives.
pub fn run(common: &CommonArguments, arguments: &ViewArguments) -> CommandResult {
    let shutdown = Shutdown::install()?;
    // As a child of a run, ends with it, however it ends.
    follow_supervisor()?;
    // Everything else on the machine takes precedence; a refusal is harmless.
    let _ = rustix::process::nice(NICENESS);
    let is_local = arguments.listen.ip().is_loopback();
    let token = (!is_local && !arguments.no_token).then(new_token).transpose()?;
    let guard = Guard {
        hosts: arguments.host.iter().cloned().chain(own_names()).collect(),
        origins: arguments.allow_origin.clone(),
        token: token.clone(),
        ..Guard::default()
    };
    let shown = match &arguments.folder {
        Some(folder) => {
            let block = read_run(folder, arguments.max_points)?;
            Shown::Finished(block, folder.clone(), read_summary(folder))
        }
        None => live(common, arguments)?,
    };
    let server = Server::open(arguments.listen, guard, shown)?;
    print_addresses(&server, arguments, token.as_deref());
    server.start()?;
    if let Shown::Live { feed, scene, .. } = &server.shown {
        let (listener, shown) = (feed.listen(USUAL_DEPTH), Arc::clone(scene));
        start("scene", move || update_scene(&listener, &shown))?;
        let (server, scene, place) = (Arc::clone(&server), Arc::clone(scene), common.place()?);
        start("history", move || follow(&place, &scene, &server.is_over))?;
    }
    let failure = wait_for_end(&shutdown, &server.shown)?;
    server.is_over.store(true, std::sync::atomic::Ordering::Relaxed);
    match failure {
        Some(failure) => Err(failure.into()),
        None => Ok(ExitCode::SUCCESS),
    }
}

fn live(
    common: &CommonArguments,
    arguments: &ViewArguments,
) -> Result<Shown, Box<dyn std::error::Error>> {
    let place = common.place()?;
    let wants = Wants { frames: true, keyframes: true, graph: true, adjustments: false };
    Ok(Shown::Live {
        feed: Feed::start(place.clone(), "view", wants)?,
        scene: Arc::new(Scene::new(arguments.max_points)),
        stream: StreamOptions {
            instance: place.instance.clone(),
            image_rate_hz: arguments.image_rate,
        },
        saver: Saver::new(place, &arguments.maps),
    })
}

/// Updates the scene from the feed until that ends.
fn update_scene(listener: &Listener, scene: &Scene) {
    while let Ok(event) = listener.next(LOOK_PERIOD) {
        event.into_iter().for_each(|event| scene.take(event));
    }
}

fn start(name: &str, run: impl FnOnce() + Send + 'static) -> std::io::Result<()> {
    std::thread::Builder::new().name(name.to_owned()).spawn(run).map(drop)
}

/// Waits for a signal, or until the topics can no longer be read.
fn wait_for_end(shutdown: &Shutdown, shown: &Shown) -> Result<Option<String>, WaitError> {
    while !shutdown.is_requested() {
        wait(&[], Some(shutdown.descriptor()), LOOK_PERIOD)?;
        if let Shown::Live { feed, .. } = shown
            && let Some(failure) = feed.failure()
        {
            return Ok(Some(failure));
        }
    }
    Ok(None)
}

/// Names of this machine in its local network.
fn own_names() -> Vec<String> {
    let name = std::fs::read_to_string(Path::new("/proc/sys/kernel/hostname")).unwrap_or_default();
    let name = name.trim();
    if name.is_empty() { Vec::new() } else { vec![name.to_owned(), format!("{name}.local")] }
}

/// Address of this machine in the network of its default route.
fn own_address() -> Option<IpAddr> {
    /// From a documentation network (RFC 5737): connecting a datagram socket selects a route and sends nothing.
    const ROUTE_PROBE_ADDRESS: (Ipv4Addr, u16) = (Ipv4Addr::new(192, 0, 2, 1), 9);
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).ok()?;
    socket.connect(ROUTE_PROBE_ADDRESS).ok()?;
    Some(socket.local_addr().ok()?.ip())
}

/// Prints the addresses to open to standard output, where a script may read them.
fn print_addresses(server: &Server, arguments: &ViewArguments, token: Option<&str>) {
    let address = server.address;
    let shown: Vec<String> = match address.ip() {
        // An unspecified address covers all: print a name that others can open, and a number in case it does not
        // resolve.
        ip if ip.is_unspecified() => {
            let number = own_address().map(|ip| SocketAddr::new(ip, address.port()).to_string());
            let name = own_names().pop().map(|name| format!("{name}:{}", address.port()));
            let known: Vec<String> = name.into_iter().chain(number).collect();
            match known.is_empty() {
                true => vec![format!("ADDRESS-OF-THIS-MACHINE:{}", address.port())],
                false => known,
            }
        }
        _ => vec![address.to_string()],
    };
    let token = token.map(|token| format!("?token={token}")).unwrap_or_default();
    for shown in &shown {
        let _ = writeln!(std::io::stdout(), "http://{shown}/{token}");
    }
    let _ = std::io::stdout().flush();
    if arguments.no_token && !address.ip().is_loopback() {
        note(&format!(
            "warning: anyone who can reach {address} can see the camera and save the map: no token is required"
        ));
    }
}
