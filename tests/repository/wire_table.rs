//! `python/semidense/_wire.py` agrees with the Rust definitions: every message field by field, every topic, every
//! code; `python/tests/offsets.json` lists the offset of each field for the Python reader's own test.
//!
//! The fields and their comments are read from `src/wire/message.rs`; sizes, names, codes and quality of service come
//! from the compiled types. To regenerate: `SEMIDENSE_WRITE_WIRE=1 cargo test --test repository wire_table`.

use std::fmt::Write;
use std::fs;
use std::path::PathBuf;

use iceoryx2::prelude::ZeroCopySend;
use semidense::service::health::{ProcessState, bucket_end_ms, scheduling_name};
use semidense::slam::keyframe::{DepthPoint, MAX_KEYFRAME_POINTS};
use semidense::slam::pose::TrackingState;
use semidense::wire::conversion::{map_state_from_code, start_frame_from_code, state_from_codes};
use semidense::wire::folders::{ROOT_VARIABLE, SYSTEM_ROOT};
use semidense::wire::message::{
    AdjustmentMessage, CommandRequest, CommandResponse, FrameHeader, GraphHeader,
    HISTOGRAM_BUCKETS, HealthMessage, KeyframeHeader, KeyframeImageHeader, KeyframePoseMessage,
    PATH_BYTES, PoseMessage, StepMessage, TEXT_BYTES,
};
use semidense::wire::place::Place;
use semidense::wire::topic::{
    ADJUSTMENT, CAPTURE_HEALTH, FRAME, GRAPH, KEYFRAME, KEYFRAME_IMAGE, MAPPER_COMMAND,
    MAPPER_HEALTH, POSE, STEP, TRACKER_HEALTH, Topic, WIRE_VERSION,
};

/// If set, the files are regenerated.
const WRITE: &str = "SEMIDENSE_WRITE_WIRE";

/// The definition of a message.
struct Message {
    name: String,
    comment: String,
    fields: Vec<Field>,
    size: usize,
    alignment: usize,
}

/// A field: its Rust name, its comment, its scalar type and size, and the length of an array.
struct Field {
    name: String,
    comment: String,
    scalar: String,
    length: Option<usize>,
    offset: usize,
}

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// The `///` comment above an item, on one line.
fn comment(attributes: &[syn::Attribute]) -> String {
    let line = |attribute: &syn::Attribute| match &attribute.meta {
        syn::Meta::NameValue(syn::MetaNameValue {
            path,
            value: syn::Expr::Lit(syn::ExprLit { lit: syn::Lit::Str(text), .. }),
            ..
        }) if path.is_ident("doc") => Some(text.value().trim().to_owned()),
        _ => None,
    };
    attributes.iter().filter_map(line).collect::<Vec<_>>().join(" ")
}

fn length_of(expression: &syn::Expr) -> usize {
    match expression {
        syn::Expr::Lit(syn::ExprLit { lit: syn::Lit::Int(number), .. }) => {
            number.base10_parse().unwrap()
        }
        syn::Expr::Path(path) => {
            match path.path.segments.last().unwrap().ident.to_string().as_str() {
                "TEXT_BYTES" => TEXT_BYTES,
                "PATH_BYTES" => PATH_BYTES,
                "HISTOGRAM_BUCKETS" => HISTOGRAM_BUCKETS,
                "KEYFRAME_POSE_ENTRIES" => {
                    semidense::slam::keyframe_pose_covariance::KEYFRAME_POSE_ENTRIES
                }
                other => panic!("the length {other} is not known to this test"),
            }
        }
        _ => panic!("a length that is neither a number nor a constant"),
    }
}

/// Scalar and length of a field's type.
fn layout_of(kind: &syn::Type) -> (String, Option<usize>) {
    match kind {
        syn::Type::Array(array) => {
            let (scalar, inner) = layout_of(&array.elem);
            assert!(inner.is_none(), "an array of arrays");
            (scalar, Some(length_of(&array.len)))
        }
        syn::Type::Path(path) => {
            match path.path.segments.last().unwrap().ident.to_string().as_str() {
                "RigidMessage" => ("f64".into(), Some(7)),
                "SimilarityMessage" => ("f64".into(), Some(8)),
                scalar => (scalar.to_owned(), None),
            }
        }
        _ => panic!("a field that is neither a scalar nor an array"),
    }
}

fn bytes_of(scalar: &str) -> usize {
    match scalar {
        "u8" => 1,
        "u16" => 2,
        "u32" | "f32" => 4,
        "u64" | "i64" | "f64" => 8,
        other => panic!("{other} is no scalar of a message"),
    }
}

/// The `#[repr(C)]` structure `name` of a file, with the layout rules of C.
fn message(file: &syn::File, name: &str) -> Message {
    let structures = file.items.iter().filter_map(|item| match item {
        syn::Item::Struct(structure) => Some(structure),
        _ => None,
    });
    let found = structures.into_iter().find(|structure| structure.ident == name);
    let structure = found.unwrap_or_else(|| panic!("no structure {name}"));
    let is_c = structure.attrs.iter().any(|a| a.path().is_ident("repr"));
    assert!(is_c, "{name} is not #[repr(C)]");
    let (mut offset, mut alignment) = (0_usize, 1);
    let mut fields = Vec::new();
    for field in &structure.fields {
        let (scalar, length) = layout_of(&field.ty);
        let bytes = bytes_of(&scalar);
        offset = offset.next_multiple_of(bytes);
        alignment = alignment.max(bytes);
        let name = field.ident.as_ref().unwrap().to_string();
        let comment = comment(&field.attrs);
        fields.push(Field { name, comment, scalar, length, offset });
        offset += bytes * length.unwrap_or(1);
    }
    let size = offset.next_multiple_of(alignment);
    Message { name: name.into(), comment: comment(&structure.attrs), fields, size, alignment }
}

/// The Python class of a message, checked against the compiled type.
fn class<T: ZeroCopySend>(text: &mut String, file: &syn::File) -> Message {
    let path = std::any::type_name::<T>();
    let message = message(file, path.rsplit("::").next().unwrap());
    let laid_out = (message.size, message.alignment);
    assert_eq!(laid_out, (size_of::<T>(), align_of::<T>()), "{path}");
    // SAFETY: it only returns a name.
    let type_name = unsafe { <T as ZeroCopySend>::type_name() };
    let Message { name, comment, size, .. } = &message;
    writeln!(text, "\n\nclass {name}(ctypes.Structure):\n    \"\"\"{}\"\"\"\n", plain(comment))
        .unwrap();
    writeln!(text, "    SIZE = {size}\n    _fields_ = [").unwrap();
    for Field { name, comment, scalar, length, .. } in &message.fields {
        let kind = match scalar.as_str() {
            "f32" => "ctypes.c_float".to_owned(),
            "f64" => "ctypes.c_double".to_owned(),
            integer => format!(
                "ctypes.c_{}",
                integer.replace('u', "uint").replace('i', "int").replace("uintnt", "uint")
            ),
        };
        let kind = length.map_or(kind.clone(), |length| format!("{kind} * {length}"));
        writeln!(text, "        # {}\n        ({name:?}, {kind}),", plain(comment)).unwrap();
    }
    writeln!(
        text,
        "    ]\n\n    @staticmethod\n    def type_name() -> str:\n        return {type_name:?}"
    )
    .unwrap();
    message
}

/// The field offsets of the messages, one message per line.
fn offsets(messages: &[Message]) -> String {
    let line = |Message { name, fields, .. }: &Message| {
        let of = |Field { name, offset, .. }: &Field| format!("{name:?}: {offset}");
        let fields: Vec<_> = fields.iter().map(of).collect();
        format!("    {name:?}: {{{}}}", fields.join(", "))
    };
    let lines: Vec<_> = messages.iter().map(line).collect();
    format!("{{\n{}\n}}\n", lines.join(",\n"))
}

/// A comment without the links and code quotes of Rust documentation.
fn plain(comment: &str) -> String {
    let mut text = comment.replace("[`", "`").replace("`]", "`");
    while let Some(begin) = text.find("`(crate") {
        let end = text[begin..].find(')').map_or(text.len(), |end| begin + end + 1);
        text.replace_range(begin + 1..end, "");
    }
    text.replace("crate::", "semidense::").replace(['\\', '"'], "'")
}

/// `LowOverlap` as `LOW_OVERLAP`.
fn constant_name(variant: &str) -> String {
    let mut name = String::new();
    for (index, letter) in variant.char_indices() {
        if index > 0 && letter.is_uppercase() {
            name.push('_');
        }
        name.extend(letter.to_uppercase());
    }
    name
}

/// A Python enumeration whose values are codes.
fn codes(text: &mut String, name: &str, comment: &str, members: &[(u32, String)]) {
    writeln!(text, "\n\nclass {name}(enum.IntEnum):\n    \"\"\"{comment}\"\"\"\n").unwrap();
    for (code, member) in members {
        writeln!(text, "    {member} = {code}").unwrap();
    }
}

fn known<T: std::fmt::Debug>(
    codes: std::ops::Range<u32>,
    of: impl Fn(u32) -> Option<T>,
) -> Vec<(u32, String)> {
    codes.filter_map(|code| Some((code, constant_name(&format!("{:?}", of(code)?))))).collect()
}

/// States and reasons: a reason's name is unique, its code only together with its state.
fn state_enumerations(text: &mut String) {
    /// More than the number of either.
    const CODES: u32 = 100;
    let head = |state: TrackingState| format!("{state:?}").split('(').next().unwrap().to_owned();
    let states: Vec<_> = (0..CODES)
        .filter_map(|code| Some((code, constant_name(&head(state_from_codes(code, 0).ok()?)))))
        .collect();
    codes(text, "State", "What a pose is worth.", &states);
    writeln!(
        text,
        "\n\nclass Reason(enum.Enum):\n    \"\"\"Why a pose is degraded or lost: (code of the state, code of the reason).\"\"\"\n"
    )
    .unwrap();
    for (state, _) in &states {
        for reason in 0..CODES {
            let name = state_from_codes(*state, reason).map(|known| format!("{known:?}"));
            if let Some((_, reason_name)) =
                name.as_deref().ok().and_then(|name| name.split_once('('))
            {
                let member = constant_name(reason_name.trim_end_matches(')'));
                writeln!(text, "    {member} = ({state}, {reason})").unwrap();
            }
        }
    }
    codes(
        text,
        "MapState",
        "What the mapper thinks of the map.",
        &known(0..CODES, |code| map_state_from_code(code).ok()),
    );
    codes(
        text,
        "StartFrame",
        "What a frame came to while there is no map.",
        &known(0..CODES, start_frame_from_code),
    );
    codes(
        text,
        "ProcessState",
        "What a process is doing.",
        &known(0..CODES, ProcessState::from_code),
    );
    let schedulings: Vec<_> =
        (0..4).map(|code| (code, constant_name(scheduling_name(code)).replace('_', ""))).collect();
    codes(text, "Scheduling", "Scheduling in force of a process.", &schedulings);
}

/// A line of the table of topics, checked against the types used by the Rust readers.
fn topic<T, H>(text: &mut String, topic: &Topic) {
    let short = |name: &'static str| match name.rsplit("::").next().unwrap() {
        "u8" => "ctypes.c_uint8".to_owned(),
        "()" => "None".to_owned(),
        name => name.to_owned(),
    };
    let Topic { owner, noun, subscribers, buffer, borrowed, history, .. } = topic;
    writeln!(
        text,
        "    \"{owner}/{noun}\": Topic(\"{owner}/{noun}\", {}, {}, {subscribers}, {buffer}, {borrowed}, {history}),",
        short(std::any::type_name::<T>()),
        short(std::any::type_name::<H>()),
    )
    .unwrap();
}

const TOPIC_CLASS: &str = r#"

class Topic(NamedTuple):
    """A data topic: its wake-up event has the same name."""

    path: str
    payload: type
    header: Optional[type]
    subscribers: int
    buffer: int
    borrowed: int
    history: int
"#;

fn topics(text: &mut String) {
    text.push_str(TOPIC_CLASS);
    text.push_str("\n\nTOPICS = {\n");
    topic::<u8, FrameHeader>(text, &FRAME);
    topic::<PoseMessage, ()>(text, &POSE);
    topic::<DepthPoint, KeyframeHeader>(text, &KEYFRAME);
    topic::<u8, KeyframeImageHeader>(text, &KEYFRAME_IMAGE);
    topic::<KeyframePoseMessage, GraphHeader>(text, &GRAPH);
    topic::<StepMessage, ()>(text, &STEP);
    topic::<AdjustmentMessage, ()>(text, &ADJUSTMENT);
    topic::<HealthMessage, ()>(text, &CAPTURE_HEALTH);
    topic::<HealthMessage, ()>(text, &TRACKER_HEALTH);
    topic::<HealthMessage, ()>(text, &MAPPER_HEALTH);
    text.push_str("}\n");
    writeln!(text, "COMMAND_TOPIC = {MAPPER_COMMAND:?}").unwrap();
}

/// The place of an instance; prefixes of some folders, for the reader's own test.
fn places(text: &mut String) {
    writeln!(text, "\nROOT_VARIABLE = {ROOT_VARIABLE:?}\nSYSTEM_ROOT = {SYSTEM_ROOT:?}").unwrap();
    text.push_str("PREFIXES = {\n");
    for folder in [SYSTEM_ROOT, "/tmp/semidense-1000", "/run/user/1000/semidense", "/tmp/ä"] {
        let place = Place::new("semidense", folder).unwrap();
        writeln!(text, "    {folder:?}: {:?},", place.prefix).unwrap();
    }
    text.push_str("}\n");
}

const HEAD: &str = r#""""The messages in shared memory. Generated from the Rust definitions: never edit it.

SEMIDENSE_WRITE_WIRE=1 cargo test --test repository wire_table
"""
# ruff: noqa
from __future__ import annotations

import ctypes
import enum
from typing import NamedTuple, Optional
"#;

/// The generated files with their content.
fn generated() -> [(&'static str, String); 2] {
    /// Bucket boundaries per line.
    const ENDS: usize = 5;
    let parse =
        |path: &str| syn::parse_file(&fs::read_to_string(root().join(path)).unwrap()).unwrap();
    let (messages, keyframe) = (parse("src/wire/message.rs"), parse("src/slam/keyframe.rs"));
    let mut text = HEAD.to_owned();
    writeln!(text, "\nWIRE_VERSION = {WIRE_VERSION}\nMAX_KEYFRAME_POINTS = {MAX_KEYFRAME_POINTS}")
        .unwrap();
    let ends: Vec<_> =
        (0..HISTOGRAM_BUCKETS).map(|index| format!("{:?}", bucket_end_ms(index))).collect();
    let lines: Vec<_> = ends.chunks(ENDS).map(|ends| ends.join(", ")).collect();
    writeln!(
        text,
        "# Where the buckets of a histogram end, milliseconds.\nBUCKET_ENDS_MS = (\n    {},\n)",
        lines.join(",\n    ")
    )
    .unwrap();
    let classes = [
        class::<FrameHeader>(&mut text, &messages),
        class::<PoseMessage>(&mut text, &messages),
        class::<KeyframeHeader>(&mut text, &messages),
        class::<DepthPoint>(&mut text, &keyframe),
        class::<KeyframeImageHeader>(&mut text, &messages),
        class::<StepMessage>(&mut text, &messages),
        class::<GraphHeader>(&mut text, &messages),
        class::<KeyframePoseMessage>(&mut text, &messages),
        class::<AdjustmentMessage>(&mut text, &messages),
        class::<HealthMessage>(&mut text, &messages),
        class::<CommandRequest>(&mut text, &messages),
        class::<CommandResponse>(&mut text, &messages),
    ];
    state_enumerations(&mut text);
    topics(&mut text);
    places(&mut text);
    [("python/semidense/_wire.py", text), ("python/tests/offsets.json", offsets(&classes))]
}

#[test]
fn python_reads_what_rust_writes() {
    for (name, generated) in generated() {
        let path = root().join(name);
        if std::env::var_os(WRITE).is_some() {
            fs::write(&path, &generated).unwrap();
        }
        let committed = fs::read_to_string(&path).unwrap_or_default();
        let first = committed.lines().zip(generated.lines()).find(|(old, new)| old != new);
        assert!(
            committed == generated,
            "{}: differs from the Rust definitions, first in {first:?}; write it anew with {WRITE}=1 cargo test --test repository wire_table",
            path.display()
        );
    }
}
