//! MCAP files for tests, written record by record.

/// Kinds of records.
const HEADER: u8 = 1;
const FOOTER: u8 = 2;
const SCHEMA: u8 = 3;
const CHANNEL: u8 = 4;
const MESSAGE: u8 = 5;
const CHUNK: u8 = 6;
const STATISTICS: u8 = 11;
const DATA_END: u8 = 15;

/// First and last bytes of every file.
const MAGIC: &[u8] = b"\x89MCAP0\r\n";

/// A bag under construction.
pub struct TestBag {
    /// The file so far.
    pub bytes: Vec<u8>,
    /// Records of the open chunk.
    pub chunk: Vec<u8>,
    /// Schemas and channels, which the summary repeats.
    summary: Vec<u8>,
    /// Number of messages of each channel.
    counts: Vec<(u16, u64)>,
}

/// A record.
pub fn record(kind: u8, content: &[u8]) -> Vec<u8> {
    let mut bytes = vec![kind];
    bytes.extend((content.len() as u64).to_le_bytes());
    bytes.extend(content);
    bytes
}

fn text(text: &str) -> Vec<u8> {
    [&(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat()
}

impl Default for TestBag {
    fn default() -> Self {
        let mut bytes = MAGIC.to_vec();
        bytes.extend(record(HEADER, &[text("ros2"), text("test")].concat()));
        Self { bytes, chunk: Vec::new(), summary: Vec::new(), counts: Vec::new() }
    }
}

impl TestBag {
    /// Adds a topic; its channel is its position among the topics, from 1.
    pub fn topic(&mut self, topic: &str, type_name: &str) -> u16 {
        let id = self.counts.len() as u16 + 1;
        let number = id.to_le_bytes();
        let schema =
            [&number[..], &text(type_name), &text("ros2msg"), &0_u32.to_le_bytes()].concat();
        let channel =
            [&number[..], &number, &text(topic), &text("cdr"), &0_u32.to_le_bytes()].concat();
        let records = [record(SCHEMA, &schema), record(CHANNEL, &channel)].concat();
        self.chunk.extend(&records);
        self.summary.extend(records);
        self.counts.push((id, 0));
        id
    }

    /// Adds a message.
    pub fn message(&mut self, channel: u16, log_nanos: i64, content: &[u8]) {
        let time = log_nanos.to_le_bytes();
        let header = [&channel.to_le_bytes()[..], &[0; 4], &time, &time].concat();
        self.chunk.extend(record(MESSAGE, &[&header[..], content].concat()));
        for (id, count) in &mut self.counts {
            *count += u64::from(*id == channel);
        }
    }

    /// Writes the open chunk, compressed by `compress`; without a name it is uncompressed.
    pub fn end_chunk(&mut self, compression: &str, compress: impl FnOnce(&[u8]) -> Vec<u8>) {
        let records = std::mem::take(&mut self.chunk);
        let crc = crc32fast::hash(&records);
        let data = compress(&records);
        let content = [
            &[0; 16][..],
            &(records.len() as u64).to_le_bytes(),
            &crc.to_le_bytes(),
            &text(compression),
            &(data.len() as u64).to_le_bytes(),
            &data,
        ]
        .concat();
        self.bytes.extend(record(CHUNK, &content));
    }

    /// The file with its summary.
    pub fn finish(mut self) -> Vec<u8> {
        if !self.chunk.is_empty() {
            self.end_chunk("", <[u8]>::to_vec);
        }
        self.bytes.extend(record(DATA_END, &[0; 4]));
        let summary = (self.bytes.len() as u64).to_le_bytes();
        self.bytes.extend(&self.summary);
        let total: u64 = self.counts.iter().map(|(_, count)| count).sum();
        let mut statistics = total.to_le_bytes().to_vec();
        statistics.extend([0; 2 + 4 * 4 + 8 * 2]);
        statistics.extend((self.counts.len() as u32 * 10).to_le_bytes());
        for (id, count) in &self.counts {
            statistics.extend(id.to_le_bytes());
            statistics.extend(count.to_le_bytes());
        }
        self.bytes.extend(record(STATISTICS, &statistics));
        self.bytes.extend(record(FOOTER, &[&summary[..], &[0; 12]].concat()));
        self.bytes.extend(MAGIC);
        self.bytes
    }
}

/// A message written field by field in little-endian CDR.
pub struct Cdr(pub Vec<u8>);

impl Cdr {
    /// Starts a message with a header of this stamp.
    pub fn stamped(nanos: i64) -> Self {
        let mut cdr = Self(vec![0, 1, 0, 0]);
        cdr.u32((nanos / 1_000_000_000) as u32);
        cdr.u32((nanos % 1_000_000_000) as u32);
        cdr.text("camera");
        cdr
    }

    fn align(&mut self, to: usize) {
        while !(self.0.len() - 4).is_multiple_of(to) {
            self.0.push(0);
        }
    }

    /// A number of four bytes.
    pub fn u32(&mut self, value: u32) {
        self.align(4);
        self.0.extend(value.to_le_bytes());
    }

    /// A number of eight bytes.
    pub fn u64(&mut self, value: u64) {
        self.align(8);
        self.0.extend(value.to_le_bytes());
    }

    /// Floating point numbers without their count.
    pub fn f64s(&mut self, values: &[f64]) {
        self.align(8);
        values.iter().for_each(|value| self.0.extend(value.to_le_bytes()));
    }

    /// A text.
    pub fn text(&mut self, text: &str) {
        self.u32(text.len() as u32 + 1);
        self.0.extend(text.as_bytes());
        self.0.push(0);
    }

    /// Bytes with their count.
    pub fn bytes(&mut self, bytes: &[u8]) {
        self.u32(bytes.len() as u32);
        self.0.extend(bytes);
    }
}

/// A `sensor_msgs/Image`.
pub fn image(
    nanos: i64,
    width: u32,
    height: u32,
    encoding: &str,
    step: u32,
    data: &[u8],
) -> Vec<u8> {
    let mut cdr = Cdr::stamped(nanos);
    cdr.u32(height);
    cdr.u32(width);
    cdr.text(encoding);
    cdr.0.push(0);
    cdr.u32(step);
    cdr.bytes(data);
    cdr.0
}

/// A `sensor_msgs/CompressedImage`.
pub fn compressed_image(nanos: i64, format: &str, data: &[u8]) -> Vec<u8> {
    let mut cdr = Cdr::stamped(nanos);
    cdr.text(format);
    cdr.bytes(data);
    cdr.0
}

/// A `sensor_msgs/CameraInfo` with K = (fx, fy, cx, cy), P with twice the focal lengths, and binning.
pub fn camera_info(
    width: u32,
    height: u32,
    model: &str,
    d: &[f64],
    k: [f64; 4],
    binning: u32,
) -> Vec<u8> {
    let [fx, fy, cx, cy] = k;
    let mut cdr = Cdr::stamped(0);
    cdr.u32(height);
    cdr.u32(width);
    cdr.text(model);
    cdr.u32(d.len() as u32);
    if !d.is_empty() {
        cdr.f64s(d);
    }
    cdr.f64s(&[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]);
    cdr.f64s(&[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
    cdr.f64s(&[2.0 * fx, 0.0, cx, 0.0, 0.0, 2.0 * fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]);
    cdr.u32(binning);
    cdr.u32(binning);
    (0..4).for_each(|_| cdr.u32(0));
    cdr.0.push(0);
    cdr.0
}

/// A `semidense_msgs/Frame`.
pub fn frame_record(nanos: i64, sequence: u64, capture_nanos: i64, exposure_nanos: u64) -> Vec<u8> {
    let mut cdr = Cdr::stamped(nanos);
    cdr.u64(sequence);
    cdr.u64(capture_nanos as u64);
    cdr.u64(0);
    cdr.u64(exposure_nanos);
    cdr.0.extend(1.5_f32.to_le_bytes());
    cdr.0
}
