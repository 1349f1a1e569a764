use std::collections::BTreeMap;

use cache_core::{Cached as _, Irradiance, Query, Sealed};
use glam::Vec3;

const RECORDS_MAX: usize = 48;

/// A record that decodes is sound and encodes to the same bytes. Sealed caches answer at the site of each record, and the
/// same however they were made.
pub fn record(data: &[u8]) {
    let mut sound = BTreeMap::new();
    for bytes in data.chunks(Irradiance::BYTES).take(RECORDS_MAX) {
        let Ok(record) = Irradiance::decode(bytes) else { continue };
        assert_eq!(record.check(), Ok(()));
        let mut again = Vec::new();
        record.encode(&mut again);
        assert_eq!(again, bytes);
        sound.entry(record.id).or_insert(record);
    }
    for a in [0.3, 10.0] {
        let (mut at_once, mut one_by_one) = (Sealed::new(a), Sealed::new(a));
        at_once.extend(sound.values().copied());
        for record in sound.values().rev() {
            one_by_one.extend([*record]);
        }
        for record in sound.values() {
            let site = Query { position: record.position, normal: record.normal };
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
