//! Small rosrust nodes, one for each role; node.py takes the same arguments.
//!
//!     node-rosrust ROLE [--option value]... [__name:=NAME]
//!
//! Each prints plain lines that the tests wait for.

use std::collections::{BTreeMap, HashMap};
use std::error::Error;
use std::thread;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use msg::std_msgs::String as Text;
use msg::topic_tools::{MuxSelect, MuxSelectReq, MuxSelectRes};
use serde::{Deserialize, Serialize};

mod msg {
    rosrust::rosmsg_include!(std_msgs / String, topic_tools / MuxSelect);
}

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

/// Publishes for ever, or `--count` messages.
fn publish(options: &Options) -> Outcome {
    let publisher = rosrust::publish(options.text("topic", ""), 10)?;
    let word = options.text("word", "hello");
    let size = options.number("size", 0.0) as usize;
    let pause = Duration::from_secs_f64(1.0 / options.number("rate", 20.0));
    println!("ready");
    for number in 0..options.number("count", 1e9) as u64 {
        if !rosrust::is_ok() {
            break;
        }
        let data = payload(word, number, size);
        publisher.send(Text { data: data.clone() })?;
        println!("sent {}", describe(&data));
        thread::sleep(pause);
    }
    rosrust::spin();
    Ok(())
}

/// Prints every message.
fn subscribe(options: &Options) -> Outcome {
    let _subscriber = rosrust::subscribe(options.text("topic", ""), 100, |message: Text| {
        println!("got {}", describe(&message.data))
    })?;
    println!("ready");
    rosrust::spin();
    Ok(())
}

/// A service that answers `echo REQUEST`.
fn serve(options: &Options) -> Outcome {
    let _service = rosrust::service::<MuxSelect, _>(options.text("service", ""), |request| {
        println!("request {}", describe(&request.topic));
        Ok(MuxSelectRes {
            prev_topic: format!("echo {}", request.topic),
        })
    })?;
    println!("ready");
    rosrust::spin();
    Ok(())
}

/// Waits for the service, then calls it `--count` times; a failed call is only told.
fn call(options: &Options) -> Outcome {
    if options.number("persistent", 0.0) > 0.0 {
        return Err("rosrust has a connection for each call".into());
    }
    let service = options.text("service", "");
    let size = options.number("size", 0.0) as usize;
    let pause = Duration::from_secs_f64(1.0 / options.number("rate", 20.0));
    println!("waiting");
    let patience = Duration::from_secs_f64(options.number("patience", 30.0));
    rosrust::wait_for_service(service, Some(patience))?;
    let mut client = rosrust::client::<MuxSelect>(service)?;
    for number in 0..options.number("count", 1.0) as u64 {
        match client.req(&MuxSelectReq {
            topic: payload("ask", number, size),
        }) {
            Ok(Ok(reply)) => {
                println!(
                    "reply {}",
                    describe(&reply.prev_topic.replacen("echo ", "", 1))
                )
            }
            Ok(Err(refusal)) => println!("failed {number} {refusal}"),
            Err(error) => {
                println!("failed {number} {error}");
                client = rosrust::client(service)?;
            }
        }
        thread::sleep(pause);
    }
    println!("done");
    Ok(())
}

/// rosrust sends the integers of serde_json's own type as strings.
#[derive(Serialize, Deserialize)]
#[serde(untagged)]
enum Value {
    Int(i32),
    Double(f64),
    Bool(bool),
    Text(String),
    List(Vec<Value>),
    Struct(BTreeMap<String, Value>),
}

fn set_parameter(options: &Options) -> Outcome {
    let value: Value = serde_json::from_str(options.text("json", ""))?;
    rosrust::param(options.text("key", ""))
        .ok_or("bad key")?
        .set(&value)?;
    println!("done");
    Ok(())
}

fn get_parameter(options: &Options) -> Outcome {
    let value: Value = rosrust::param(options.text("key", ""))
        .ok_or("bad key")?
        .get()?;
    println!("value {}", serde_json::to_string(&value)?);
    Ok(())
}

fn main() -> Outcome {
    env_logger::init();
    let words = rosrust::args();
    let options = words[2..].chunks_exact(2);
    let options = Options(
        options
            .map(|pair| (pair[0].replacen("--", "", 1), pair[1].clone()))
            .collect(),
    );
    rosrust::init("node");
    println!("node {}", rosrust::name());
    let outcome = match words[1].as_str() {
        "pub" => publish(&options),
        "sub" => subscribe(&options),
        "serve" => serve(&options),
        "call" => {
            // On a thread, as the call of a service that is gone takes half a minute to fail.
            let calls = thread::spawn(move || call(&options).map_err(|error| error.to_string()));
            while rosrust::is_ok() && !calls.is_finished() {
                thread::sleep(Duration::from_millis(20));
            }
            if calls.is_finished() {
                Ok(calls.join().unwrap()?)
            } else {
                Ok(())
            }
        }
        "setparam" => set_parameter(&options),
        "getparam" => get_parameter(&options),
        role => Err(format!("unknown role {role}").into()),
    };
    rosrust::shutdown(); // Else /rosout stays at the master.
    outcome
}
