use std::collections::BTreeMap;

use cache_core::{Irradiance, Packed as _, Query, Sealed, Shrink};
use glam::Vec3;

const RECORDS_MAX: usize = 48;

/// A record that decodes is sound and encodes to the same bytes. Sealed caches answer at the site of each record, and the
/// same however they were made, whatever is proposed for their records: the first byte of its noise says what.
pub fn record(data: &[u8]) {
    let (mut sound, mut shrinks) = (BTreeMap::new(), Vec::new());
    for bytes in data.chunks(Irradiance::BYTES).take(RECORDS_MAX) {
        let Ok(record) = Irradiance::decode(bytes) else { continue };
        assert_eq!(record.check(), Ok(()));
        // Said once more, in other words than the check's.
        assert!(bytes[16..].chunks(4).all(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]).is_finite()));
        let far = record.position.to_array().into_iter().chain([record.radius_max]).map(|x| f64::from(x.abs()));
        assert!(f64::from(record.radius) > 2e-10 * far.fold(0.0, f64::max), "{record:?}");
        let mut again = Vec::new();
        record.encode(&mut again);
        assert_eq!(again, bytes);
        let a = f32::from(bytes[124] & 7) * 0.01;
        if a > 0.0 && !sound.contains_key(&record.id) {
            let shrink = Shrink::new(record.id, a);
            again.clear();
            shrink.encode(&mut again);
            assert_eq!(Shrink::decode(&again), Ok(shrink));
            shrinks.push(shrink);
        }
        sound.entry(record.id).or_insert(record);
    }
    for a in [0.3, 10.0] {
        let (mut at_once, mut one_by_one) = (Sealed::new(a), Sealed::new(a));
        at_once.extend(sound.values().copied());
        at_once.shrink(shrinks.iter().copied());
        shrinks.iter().rev().for_each(|shrink| one_by_one.shrink([*shrink]));
        for record in sound.values().rev() {
            one_by_one.extend([*record]);
        }
        for record in sound.values() {
            let site = Query::new(record.position, record.normal);
            assert!(at_once.covers(&site), "{record:?}");
            let beside = Query { position: record.position + Vec3::splat(record.radius * a * 0.3), ..site };
            for query in [site, beside] {
                let bits = |sealed: &Sealed<Irradiance>| {
                    sealed.ask(&query).map(|answer| (answer.irradiance.to_array().map(f32::to_bits), answer.records))
                };
                assert_eq!(bits(&at_once), bits(&one_by_one));
                assert_eq!(at_once.covers(&query), at_once.ask(&query).is_some());
            }
        }
    }
}
