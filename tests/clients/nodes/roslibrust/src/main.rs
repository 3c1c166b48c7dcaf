//! Small roslibrust nodes, one for each role; node.py takes the same arguments.
//!
//!     node-roslibrust ROLE [--option value]... [__name:=NAME]
//!
//! Each prints plain lines that the tests wait for.

use std::collections::HashMap;
use std::error::Error;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use roslibrust::ros1::NodeHandle;
use std_msgs::String as Text;
use tokio::signal::unix::{signal, SignalKind};
use tokio::time::{sleep, Instant};
use topic_tools::{MuxSelect, MuxSelectRequest, MuxSelectResponse};

roslibrust::generate_ros_types_with_env!();

type Outcome = Result<(), Box<dyn Error>>;

/// The `--option value` pairs of the command line.
struct Options(HashMap<String, String>);

impl Options {
    fn text<'a>(&'a self, name: &str, default: &'a str) -> &'a str {
        self.0.get(name).map_or(default, String::as_str)
    }

    fn number(&self, name: &str, default: f64) -> f64 {
        self.0
            .get(name)
            .map_or(default, |value| value.parse().expect(name))
    }
}

/// `word number` filled up to `size` characters.
fn payload(word: &str, number: u64, size: usize) -> String {
    let mut text = format!("{word} {number} ");
    let rest = size.saturating_sub(text.len());
    text.extend(('a'..='z').cycle().take(rest));
    text
}

/// What identifies a payload: its first two words, its size and its checksum.
fn describe(text: &str) -> String {
    let words: Vec<_> = text.split(' ').take(2).collect();
    let checksum = crc32fast::hash(text.as_bytes());
    let time = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .unwrap()
        .as_secs_f64();
    format!(
        "{} size {} crc {checksum:08x} at {time:.3}",
        words.join(" "),
        text.len()
    )
}

// A role is dropped when a signal comes. What it has made unregisters itself at the master in a
// task that the end of the program may cut off; the node does so at once, so it is the last thing
// that a role makes and the first to be dropped.

/// Publishes for ever, or `--count` messages.
async fn publish(node: NodeHandle, options: &Options) -> Outcome {
    let publisher = node.advertise(options.text("topic", ""), 10, false).await?;
    let _node = node;
    let word = options.text("word", "hello");
    let size = options.number("size", 0.0) as usize;
    let pause = Duration::from_secs_f64(1.0 / options.number("rate", 20.0));
    println!("ready");
    for number in 0..options.number("count", 1e9) as u64 {
        let message = Text {
            data: payload(word, number, size),
        };
        publisher.publish(&message).await?;
        println!("sent {}", describe(&message.data));
        sleep(pause).await;
    }
    std::future::pending().await
}

/// Prints every message.
async fn subscribe(node: NodeHandle, options: &Options) -> Outcome {
    let mut subscriber = node
        .subscribe::<Text>(options.text("topic", ""), 100)
        .await?;
    let _node = node;
    println!("ready");
    while let Some(message) = subscriber.next().await {
        match message {
            Ok(message) => println!("got {}", describe(&message.data)),
            Err(error) => eprintln!("{error}"),
        }
    }
    Ok(())
}

/// A service that answers `echo REQUEST`.
async fn serve(node: NodeHandle, options: &Options) -> Outcome {
    let answer = |request: MuxSelectRequest| {
        println!("request {}", describe(&request.topic));
        Ok(MuxSelectResponse {
            prev_topic: format!("echo {}", request.topic),
        })
    };
    let _service = node
        .advertise_service::<MuxSelect, _>(options.text("service", ""), answer)
        .await?;
    let _node = node;
    println!("ready");
    std::future::pending().await
}

/// Waits for the service, then calls it `--count` times; a failed call is only told.
/// A client is one connection for ever: without `--persistent 1` each call has its own.
async fn call(node: NodeHandle, options: &Options) -> Outcome {
    let service = options.text("service", "");
    let persistent = options.number("persistent", 0.0) > 0.0;
    let size = options.number("size", 0.0) as usize;
    let pause = Duration::from_secs_f64(1.0 / options.number("rate", 20.0));
    let end = Instant::now() + Duration::from_secs_f64(options.number("patience", 30.0));
    println!("waiting");
    let mut client = loop {
        match node.service_client::<MuxSelect>(service).await {
            Ok(client) => break Some(client),
            Err(error) if Instant::now() > end => return Err(error.into()),
            Err(_) => sleep(Duration::from_millis(100)).await,
        }
    };
    for number in 0..options.number("count", 1.0) as u64 {
        let result: Result<_, Box<dyn Error>> = async {
            if client.is_none() {
                client = Some(node.service_client(service).await?);
            }
            let request = MuxSelectRequest {
                topic: payload("ask", number, size),
            };
            Ok(client.as_ref().unwrap().call(&request).await?.prev_topic)
        }
        .await;
        if result.is_err() || !persistent {
            client = None;
        }
        match result {
            Ok(reply) => println!("reply {}", describe(&reply.replacen("echo ", "", 1))),
            Err(error) => println!("failed {number} {error}"),
        }
        sleep(pause).await;
    }
    println!("done");
    Ok(())
}

#[tokio::main]
async fn main() -> Outcome {
    env_logger::init();
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut terminate = signal(SignalKind::terminate())?;
    let (settings, words): (Vec<_>, Vec<_>) = std::env::args()
        .skip(1)
        .partition(|word| word.contains(":="));
    let name = settings
        .iter()
        .find_map(|word| word.strip_prefix("__name:="))
        .unwrap_or("node");
    let options = words[1..].chunks_exact(2);
    let options = Options(
        options
            .map(|pair| (pair[0].replacen("--", "", 1), pair[1].clone()))
            .collect(),
    );
    let master = std::env::var("ROS_MASTER_URI").unwrap_or("http://localhost:11311".into());
    let node = NodeHandle::new(&master, name).await?;
    println!("node /{name}");
    let role = async {
        match words[0].as_str() {
            "pub" => publish(node, &options).await,
            "sub" => subscribe(node, &options).await,
            "serve" => serve(node, &options).await,
            "call" => call(node, &options).await,
            role => Err(format!("roslibrust has no {role}").into()), // It has no parameters.
        }
    };
    tokio::select! {
        outcome = role => outcome,
        _ = interrupt.recv() => Ok(()),
        _ = terminate.recv() => Ok(()),
    }
}
