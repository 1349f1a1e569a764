//! Where the fuzzer begins: small inputs that reach far, made here so that no binary files need to be kept.

use cache_core::{Irradiance, Namespace, Packed as _, RecordId, Shrink, Tag};
use cache_proto::convert;
use cache_proto::v1::{self, entry::Entry as Kind};
use cache_server::journal::value::Place;
use glam::{Vec2, Vec3};
use prost::Message as _;

use super::{frame, piece};

/// The seeds of a target by its name.
pub fn seeds(target: &str) -> Vec<Vec<u8>> {
    match target {
        "record" => record(),
        "batch" => batch(),
        "store" => store(),
        "scene" => scene(),
        "frame" => opened(),
        _ => Vec::new(),
    }
}

fn sample(number: u8) -> Irradiance {
    Irradiance {
        id: RecordId(u128::from(number) << 120 | 0x0123_4567_89ab_cdef),
        position: Vec3::new(number.into(), 1.0, 2.0),
        normal: Vec3::Y,
        radius: 2.0,
        radius_min: 0.1,
        radius_max: 10.0,
        irradiance: Vec3::new(1.0, 2.0, 3.0),
        gradient_t: [Vec2::new(0.1, -0.2); 3],
        gradient_r: [Vec2::new(0.3, -0.4); 3],
        ellipse: [0.0; 3],
        noise: 0.0,
    }
}

fn record() -> Vec<Vec<u8>> {
    let many = |count: u8, change: fn(&mut Irradiance, u8)| {
        let mut bytes = Vec::new();
        for number in 0..count {
            let mut record = sample(number);
            change(&mut record, number);
            record.encode(&mut bytes);
        }
        bytes
    };
    vec![
        many(1, |_, _| ()),
        many(5, |_, _| ()),
        many(5, |r, n| r.noise = f32::from_bits(0x3f80_0000 | u32::from(n))),
        many(4, |r, n| (r.radius, r.radius_min) = (1e-30 * f32::from(n + 1), 1e-38)),
        many(4, |r, n| (r.radius, r.position) = (1e-30, Vec3::splat(1e-22 * f32::from(n)))),
        many(4, |r, n| (r.radius, r.radius_max, r.position.x) = (3e-9, 0.1, f32::from(n))),
        many(3, |r, n| r.irradiance.z = [f32::NAN, f32::INFINITY, -0.0][usize::from(n)]),
        many(4, |r, n| (r.position.x, r.radius, r.radius_max) = (1e18 / f32::from(n + 1), 1e18, 1e18)),
    ]
}

fn namespace(byte: u8) -> Namespace {
    Namespace([byte; 32])
}

fn entries() -> Vec<v1::Entry> {
    let bytes = |byte: u8| vec![byte; 32].into();
    let batch = |n: u8, step| convert::pack(&namespace(n), Tag { level: 1, step }, &[sample(n), sample(n + 1)]);
    let label = v1::Label { namespace: bytes(1), scene: "a.glb".into(), draft_of: bytes(2), ..Default::default() };
    let publication = v1::Publication { draft: bytes(1), namespace: bytes(2) };
    let kinds = [
        Kind::Batch(batch(1, 3)),
        Kind::Label(label),
        Kind::Publication(publication),
        Kind::Batch(batch(1, 4)),
        Kind::Batch(batch(2, 0)),
        Kind::Batch(convert::pack(&namespace(1), Tag { level: 1, step: 5 }, &[Shrink::new(sample(1).id, 0.1)])),
    ];
    kinds.into_iter().map(|kind| v1::Entry { entry: Some(kind) }).collect()
}

fn payload(entries: &[v1::Entry]) -> Vec<u8> {
    entries.iter().flat_map(v1::Entry::encode_length_delimited_to_vec).collect()
}

fn batch() -> Vec<Vec<u8>> {
    let insert = v1::InsertRequest { batch: Some(convert::pack(&namespace(1), Tag::level(1), &[sample(1)])) };
    let short = [
        piece(4, &[1, 5]),
        piece(1, &[1]),
        piece(5, &[1, 0x10, 1, 2, 3]),
        piece(5, &[1, 0x20, 2, 5]),
        piece(3, &[1, 2]),
        piece(2, &[1]),
        piece(1, &[1]),
        piece(5, &[2, 0, 9, 8]),
    ];
    // A batch that says it holds a billion records, alone and as an entry; one of a length beyond any memory.
    let claim = |bytes: u64| {
        let mut claim = vec![0x0a];
        prost::encoding::encode_varint(bytes, &mut claim);
        [&claim, &insert.encode_to_vec()[2..]].concat()
    };
    let entry = [&[255, 255, 255, 255, 7][..], &claim(128_000_000_000)].concat();
    vec![
        insert.encode_to_vec(),
        piece(0, &payload(&entries())),
        short.concat(),
        claim(128_000_000_000),
        claim(u64::MAX),
        piece(0, &entry),
    ]
}

fn store() -> Vec<Vec<u8>> {
    let patch = |kind: u8, at: u32, bytes: &[u8]| piece(kind, &[&at.to_le_bytes()[..3], bytes].concat());
    let value = Place::default().seal(&entries());
    let kinds = [1, 2].into_iter();
    let patched = kinds.flat_map(|file| {
        [
            vec![file],
            [&[file][..], &patch(2, 64, &[1])].concat(),
            [&[file][..], &patch(2, 4096, &[255; 8])].concat(),
            [&[file][..], &patch(1, 20_000, &[]), &patch(0, 0, &[0; 64])].concat(),
            [&[file][..], &patch(0, 12_000, &[7; 300])].concat(),
        ]
    });
    let values = [
        &[3][..],
        &piece(1, &[&[0, 6][..], &payload(&entries())].concat()),
        &piece(0, b"between"),
        &piece(4, &[&[9, 2][..], &payload(&entries()[3..])].concat()),
        &piece(254, &[255, 255, 0]),
    ];
    // Headers that claim four gigabytes, and more records than can be counted.
    let claims = [(12, 4), (24, 16)].map(|(at, bytes)| {
        let mut value = [&[0][..], &value].concat();
        value[1 + at..1 + at + bytes].fill(0xff);
        value
    });
    let whole = [[&[0][..], &value].concat(), values.concat()];
    whole.into_iter().chain(claims).chain(patched).collect()
}

fn scene() -> Vec<Vec<u8>> {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/scenes/");
    let files = [
        (0, "cornell.glb"),
        (0, "glossy-floor.glb"),
        (0, "white-furnace.glb"),
        (2, "cornell.rad"),
        (2, "leak.rad"),
        (3, "cornell.vf"),
    ];
    let read = |(kind, name): (u8, &str)| {
        let bytes = std::fs::read(format!("{folder}{name}")).or_else(|_| std::fs::read(format!("tests/scenes/{name}")));
        [&[kind][..], &bytes.expect("the workspace's scenes")].concat()
    };
    let triangle = br#"{"asset":{"version":"2.0"},"scene":0,"scenes":[{"nodes":[0,1,2]}],"nodes":[{"mesh":0,
"rotation":[0,0,0,1],"scale":[1,2,3]},{"camera":0,"translation":[0,0,5]},{"extensions":{"KHR_lights_punctual":
{"light":0}}}],"cameras":[{"type":"perspective","perspective":{"yfov":1,"znear":0.1}}],"extensionsUsed":
["KHR_lights_punctual"],"extensions":{"KHR_lights_punctual":{"lights":[{"type":"spot","intensity":5,"spot":
{"outerConeAngle":0.5}}]}},"meshes":[{"primitives":[{"attributes":{"POSITION":0},"material":0}]}],"materials":
[{"pbrMetallicRoughness":{"baseColorFactor":[1,0.5,0.2,1],"baseColorTexture":{"index":0}}}],"textures":[{"source":0}],
"images":[{"uri":"data:image/png;base64,iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="}],
"accessors":[{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3"}],"bufferViews":[{"buffer":0,
"byteLength":36}],"buffers":[{"byteLength":36,"uri":"data:;base64,AAAAAAAAAAAAAAAAAACAPwAAAAAAAAAAAAAAAAAAgD8AAAAA"}]}"#;
    let shapes =
        b"void plastic red 0 0 5 .7 .1 .1 0.05 0.1\nvoid metal m 0 0 5 .7 .1 .1 0.9 0\nvoid glow g 0 0 4 1 1 1 0
m sphere s 0 0 4 0 0 0 1\nred cylinder c 0 0 7 0 0 0 0 0 1 .5\nred cone k 0 0 8 0 0 0 0 0 1 .5 .1
red ring r 0 0 8 0 0 0 0 0 1 .5 1\ng source sky 0 0 4 0 0 1 180\nred alias r2 red
void mixfunc mix 4 red m .3 . 0 0\nmix bubble b 0 0 4 3 0 0 1
red polygon p 0 0 24 0 0 0 4 0 0 4 4 0 0 4 0 0 0 0 1 1 0 1 2 0 2 2 0
!xform -rx 90 -t 1 2 3 -s 2 -mx -a 3 -t 1 0 0 part.rad\n";
    let views = b"rvu -vtl -vp 1 2 3 -vd 0 0 -1 -vu 0 1 0 -vh 4 -vv 3 -vo 0 -va 0 -vs 0 -vl 0\nVIEW= -vtv -vh 60\n";
    let texts = [(1, &triangle[..]), (2, shapes), (3, views)];
    let texts = texts.into_iter().map(|(kind, text)| [&[kind][..], text].concat());
    files.into_iter().map(read).chain(texts).collect()
}

fn opened() -> Vec<Vec<u8>> {
    let open = |spec| v1::OpenRequest { spec: Some(spec), ..Default::default() }.encode_to_vec();
    let path = v1::FrameSpec { method: "path".into(), levels: 0, width: 9, height: 7, ..frame::spec() };
    let tiles = vec![v1::FrameTile { tile: 0, pixels: vec![0; 1024].into() }];
    let complete = v1::CompleteRequest {
        worker: "w0".into(),
        lease: 2,
        frame: 1,
        gathered: 0,
        tiles,
        counts: vec![v1::Count { name: "queries".into(), value: 3.0 }],
        worked_seconds: 0.25,
        used: None,
    };
    let claims = [
        v1::CompleteRequest { gathered: u64::MAX, ..complete.clone() },
        v1::CompleteRequest { worked_seconds: f64::NAN, ..complete.clone() },
        v1::CompleteRequest { worked_seconds: f64::MAX, tiles: Vec::new(), ..complete.clone() },
    ];
    let claims = claims.map(|request| [piece(2, &[0]), piece(1, &request.encode_to_vec())].concat()).concat();
    let huge = [(u32::MAX, 1), (65536, 65536), (1, u32::MAX)]
        .map(|(width, height)| piece(0, &open(v1::FrameSpec { width, height, tile_size: 1, ..frame::spec() })));
    let rounds = [piece(2, &[0]), piece(2, &[1]), piece(3, &[0, 0, 13, 0]), piece(3, &[0, 0, 13, 1])].concat();
    let pixels = [piece(0, &open(path)), piece(9, &[1]), rounds.clone(), piece(8, &[2])].concat();
    let late = [piece(2, &[0]), piece(7, &[70]), piece(2, &[1]), piece(4, &[1]), piece(6, b"\x01\x01why")].concat();
    vec![
        piece(0, &open(frame::spec())),
        pixels,
        rounds.repeat(12),
        [piece(2, &[0]), piece(1, &complete.encode_to_vec())].concat(),
        [late, piece(5, &[1]), piece(8, &[1])].concat(),
        claims,
        huge.concat(),
    ]
}
