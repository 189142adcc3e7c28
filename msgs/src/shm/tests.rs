//! Layout and conversions of the forms.

use std::mem::{align_of, offset_of, size_of};

use proptest::prelude::*;

use super::*;
use crate::{
    Derivatives, Heard, Mode, ModeSensitivity, OperatingPoint, PairSensitivity, Prediction, Sensitivity, Waveform,
    heard_quantity, heard_state, heard_verdict,
};

fn prediction(modes: usize, reason: &str) -> Prediction {
    Prediction {
        header: Header { stamp: Time { sec: 7, nanosec: 8 }, frame_id: String::new() },
        input_seq: u64::MAX,
        level: level::SQUEAL,
        reused: true,
        unstable_modes: 2,
        max_growth_rate_per_s: 12.5,
        worst_frequency_hz: 1750.25,
        critical_friction: 0.4,
        friction_margin: -0.1,
        friction_margin_error: 1e-12,
        reason: reason.to_owned(),
        modes: (0..modes)
            .map(|i| Mode { id: i as u32, frequency_hz: 100.0 * i as f64, residual: 1e-12, ..Mode::default() })
            .collect(),
    }
}

/// Peers in other languages map these bytes: sizes and offsets must be those of the tables at the structures.
#[test]
fn layout_is_the_documented_one() {
    assert_eq!((size_of::<OperatingPointForm>(), align_of::<OperatingPointForm>()), (40, 8));
    assert_eq!(
        [
            offset_of!(OperatingPointForm, stamp_ns),
            offset_of!(OperatingPointForm, seq),
            offset_of!(OperatingPointForm, normal_load_n),
            offset_of!(OperatingPointForm, disc_speed_rad_s),
            offset_of!(OperatingPointForm, friction_coefficient),
        ],
        [0, 8, 16, 24, 32]
    );
    assert_eq!((size_of::<TemperatureForm>(), align_of::<TemperatureForm>()), (24, 8));
    let offsets = [
        offset_of!(TemperatureForm, stamp_ns),
        offset_of!(TemperatureForm, temperature_c),
        offset_of!(TemperatureForm, variance_k2),
    ];
    assert_eq!(offsets, [0, 8, 16]);
    assert_eq!((size_of::<VibrationForm>(), align_of::<VibrationForm>()), (24, 8));
    assert_eq!(
        [
            offset_of!(VibrationForm, stamp_ns),
            offset_of!(VibrationForm, frequency_hz),
            offset_of!(VibrationForm, level_db),
        ],
        [0, 8, 16]
    );
    assert_eq!((size_of::<ModeForm>(), align_of::<ModeForm>()), (64, 8));
    assert_eq!(
        [
            offset_of!(ModeForm, id),
            offset_of!(ModeForm, zero),
            offset_of!(ModeForm, frequency_hz),
            offset_of!(ModeForm, growth_rate_per_s),
            offset_of!(ModeForm, damping_ratio),
            offset_of!(ModeForm, pad_participation),
            offset_of!(ModeForm, residual),
            offset_of!(ModeForm, frequency_error_hz),
            offset_of!(ModeForm, growth_rate_error_per_s),
        ],
        [0, 4, 8, 16, 24, 32, 40, 48, 56]
    );
    assert_eq!((size_of::<PredictionForm>(), align_of::<PredictionForm>()), (4296, 8));
    assert_eq!(
        [
            offset_of!(PredictionForm, stamp_ns),
            offset_of!(PredictionForm, input_seq),
            offset_of!(PredictionForm, max_growth_rate_per_s),
            offset_of!(PredictionForm, worst_frequency_hz),
            offset_of!(PredictionForm, critical_friction),
            offset_of!(PredictionForm, friction_margin),
            offset_of!(PredictionForm, friction_margin_error),
            offset_of!(PredictionForm, unstable_modes),
            offset_of!(PredictionForm, mode_count),
            offset_of!(PredictionForm, level),
            offset_of!(PredictionForm, reused),
            offset_of!(PredictionForm, reason_len),
            offset_of!(PredictionForm, zero),
            offset_of!(PredictionForm, reason),
            offset_of!(PredictionForm, modes),
        ],
        [0, 8, 16, 24, 32, 40, 48, 56, 60, 64, 65, 66, 67, 72, 200]
    );
}

#[test]
fn sensitivities_come_back_whole_in_the_documented_layout() {
    assert_eq!([size_of::<ModeSensitivityForm>(), size_of::<PairSensitivityForm>()], [88, 208]);
    assert_eq!((size_of::<SensitivityForm>(), align_of::<SensitivityForm>()), (12384, 8));
    let counts = [offset_of!(SensitivityForm, mode_count), offset_of!(SensitivityForm, pair_count)];
    let lists = [offset_of!(SensitivityForm, modes), offset_of!(SensitivityForm, pairs)];
    assert_eq!((counts, lists), ([88, 92], [96, 5728]));
    assert_eq!(offset_of!(PairSensitivityForm, discriminant_derivatives), 128);
    let derivatives = |k: usize| Derivatives::new(std::array::from_fn(|j| (10 * k + j) as f64));
    let mode = |k: usize| ModeSensitivity {
        id: k as u32,
        law: (k % 2) as u8,
        frequency_hz: derivatives(k),
        growth_rate_per_s: derivatives(k + 100),
    };
    let pair = |k: usize| PairSensitivity {
        first_id: k as u32,
        second_id: 1 + k as u32,
        squares: k % 2 == 1,
        mean_real: 1.0,
        mean_imaginary: 2.0,
        discriminant_real: 3.0,
        discriminant_imaginary: 4.0,
        mean_real_derivatives: derivatives(k),
        mean_imaginary_derivatives: derivatives(k + 1),
        discriminant_real_derivatives: derivatives(k + 2),
        discriminant_imaginary_derivatives: derivatives(k + 3),
    };
    let message = Sensitivity {
        header: Header { stamp: Time { sec: 7, nanosec: 8 }, frame_id: String::new() },
        input_seq: 9,
        normal_load_n: 500.0,
        disc_speed_rad_s: 13.0,
        friction_coefficient: 0.3,
        nearest_window_end: 0.35,
        nearest_window_end_derivatives: derivatives(7),
        modes: (0..MAX_MODES).map(mode).collect(),
        pairs: (0..MAX_PAIRS).map(pair).collect(),
    };
    let form = SensitivityForm::from_message(&message).expect("fits");
    assert_eq!(form.to_message().expect("is one"), message);
    let refused = |form: SensitivityForm| form.to_message().expect_err("is none");
    assert_eq!(refused(SensitivityForm { pair_count: 33, ..form }), FormError::PairCount { found: 33 });
    let mut bad = form;
    bad.modes[3].law = 2;
    assert_eq!(refused(bad), FormError::Law(2));
}

fn heard() -> Heard {
    Heard {
        header: Header { stamp: Time { sec: 7, nanosec: 8 }, frame_id: String::new() },
        channel: "microphone".to_owned(),
        number: 3,
        state: heard_state::ENDED,
        end_stamp: Time { sec: 8, nanosec: 9 },
        cut_at_onset: true,
        cut_at_end: false,
        frequency_hz: 1750.25,
        quantity: heard_quantity::ACCELERATION,
        level_db: 90.0,
        peak_level_db: 91.0,
        prominence_db: 20.0,
        growth_rate_per_s: 30.0,
        growth_rate_low_per_s: 29.0,
        growth_rate_high_per_s: 31.0,
        harmonic_order: 2,
        harmonic_of: 1,
        verdict: heard_verdict::NOT_JUDGED,
        mode_id: 5,
        predicted_frequency_hz: 1740.0,
        predicted_growth_rate_per_s: 33.0,
        input_seq: u64::MAX,
        prediction_stamp: Time { sec: 6, nanosec: 5 },
    }
}

#[test]
fn squeals_come_back_whole_in_the_documented_layout() {
    assert_eq!((size_of::<HeardForm>(), align_of::<HeardForm>()), (264, 8));
    let places = [
        offset_of!(HeardForm, prediction_stamp_ns),
        offset_of!(HeardForm, input_seq),
        offset_of!(HeardForm, growth_rate_per_s),
        offset_of!(HeardForm, predicted_growth_rate_per_s),
        offset_of!(HeardForm, mode_id),
        offset_of!(HeardForm, state),
        offset_of!(HeardForm, cut),
        offset_of!(HeardForm, channel_len),
        offset_of!(HeardForm, channel),
    ];
    assert_eq!(places, [16, 40, 80, 112, 124, 128, 131, 133, 136]);
    let form = HeardForm::from_message(&heard()).expect("fits");
    assert_eq!(form.to_message().expect("is one"), heard());
    let refused = |form: HeardForm| form.to_message().expect_err("is none").to_string();
    assert_eq!(refused(HeardForm { verdict: 4, ..form }), "verdict 4, expected 0 to 3");
    assert_eq!(refused(HeardForm { cut: [0, 2], ..form }), "cut_at_end 2, expected 0 to 1");
    assert_eq!(refused(HeardForm { channel_len: 129, ..form }), "channel has 129 bytes, at most 128 are carried");
    let bad = Heard { state: 2, ..heard() };
    assert!(matches!(HeardForm::from_message(&bad), Err(FormError::Value { field: "state", .. })));
}

#[test]
fn waveforms_come_back_whole_in_the_documented_layout() {
    assert_eq!((size_of::<WaveformHeader>(), align_of::<WaveformHeader>()), (200, 8));
    let places = [
        offset_of!(WaveformHeader, sample_rate_hz),
        offset_of!(WaveformHeader, channel_len),
        offset_of!(WaveformHeader, channel),
        offset_of!(WaveformHeader, unit),
        offset_of!(WaveformHeader, sensitivity),
    ];
    assert_eq!(places, [8, 16, 24, 152, 168]);
    let message = Waveform {
        header: Header { stamp: Time { sec: 7, nanosec: 8 }, frame_id: String::new() },
        channel: "m".repeat(128),
        sample_rate_hz: 51_200.0,
        unit: "m/s²".to_owned(),
        sensitivity: "100 mV/g".to_owned(),
        samples: vec![1.5; MAX_WAVEFORM_SAMPLES],
    };
    let header = WaveformHeader::from_message(&message).expect("fits");
    assert_eq!(header.to_message(&message.samples).expect("is one"), message);
    let long = vec![0.0; MAX_WAVEFORM_SAMPLES + 1];
    assert_eq!(header.to_message(&long), Err(FormError::SampleCount { found: MAX_WAVEFORM_SAMPLES + 1 }));
    let mut bad = header;
    bad.unit[0] = 0xff;
    assert_eq!(bad.to_message(&[]).expect_err("is none").to_string(), "unit is valid UTF-8 only up to byte 0");
    let message = Waveform { channel: "m".repeat(300), ..message };
    let error = WaveformHeader::from_message(&message).expect_err("does not fit").to_string();
    assert_eq!(error, "channel has 300 bytes, at most 128 are carried");
}

#[test]
fn type_names_carry_a_version() {
    let names = unsafe {
        [
            <OperatingPointForm as ZeroCopySend>::type_name(),
            <PredictionForm as ZeroCopySend>::type_name(),
            <ModeForm as ZeroCopySend>::type_name(),
            <VibrationForm as ZeroCopySend>::type_name(),
            <WaveformHeader as ZeroCopySend>::type_name(),
            <HeardForm as ZeroCopySend>::type_name(),
        ]
    };
    let expected = [
        "squealcast/OperatingPoint/1",
        "squealcast/Prediction/2",
        "squealcast/Mode/1",
        "squealcast/Vibration/1",
        "squealcast/Waveform/1",
        "squealcast/Heard/1",
    ];
    assert_eq!(names, expected);
}

#[test]
fn predictions_come_back_whole() {
    for modes in [0, 1, MAX_MODES] {
        let message = prediction(modes, "margin pending");
        let form = PredictionForm::from_message(&message).expect("fits");
        assert_eq!(form.to_message().expect("is one"), message);
    }
}

#[test]
fn nan_keeps_its_bits() {
    let message = Prediction { critical_friction: f64::NAN, ..prediction(0, "") };
    let back = PredictionForm::from_message(&message).expect("fits").to_message().expect("is one");
    assert_eq!(back.critical_friction.to_bits(), message.critical_friction.to_bits());
}

#[test]
fn a_long_reason_is_cut_between_characters() {
    // 127 bytes, then a character of two bytes that does not fit into 128.
    let reason = format!("{}ä tail", "x".repeat(127));
    let form = PredictionForm::from_message(&prediction(0, &reason)).expect("fits");
    assert_eq!(form.reason_len, 127);
    assert_eq!(form.to_message().expect("is one").reason, "x".repeat(127));
    let exact = "y".repeat(REASON_BYTES);
    let form = PredictionForm::from_message(&prediction(0, &exact)).expect("fits");
    assert_eq!(form.to_message().expect("is one").reason, exact);
}

#[test]
fn messages_that_do_not_fit_are_refused() {
    assert_eq!(PredictionForm::from_message(&prediction(65, "")), Err(FormError::ModeCount { found: 65 }));
    let bad_level = Prediction { level: 4, ..prediction(0, "") };
    assert_eq!(PredictionForm::from_message(&bad_level), Err(FormError::Level(4)));
}

#[test]
fn bytes_that_are_no_message_are_refused() {
    let good = PredictionForm::from_message(&prediction(2, "why")).expect("fits");
    let refused = |form: PredictionForm| form.to_message().expect_err("is none");
    assert_eq!(refused(PredictionForm { mode_count: 65, ..good }), FormError::ModeCount { found: 65 });
    assert_eq!(refused(PredictionForm { level: 9, ..good }), FormError::Level(9));
    assert_eq!(refused(PredictionForm { reused: 2, ..good }), FormError::Reused(2));
    assert_eq!(refused(PredictionForm { reason_len: 129, ..good }), FormError::ReasonLength(129));
    let mut broken = good;
    broken.reason[1] = 0xff;
    assert_eq!(refused(broken), FormError::ReasonUtf8 { valid_up_to: 1 });
    assert_eq!(refused(PredictionForm { stamp_ns: i64::MAX, ..good }), FormError::Stamp(i64::MAX));
}

proptest! {
    #[test]
    fn operating_points_come_back_whole(
        sec: i32, nanosec in 0u32..1_000_000_000, seq: u64, load: u64, speed: u64, friction: u64,
    ) {
        let message = OperatingPoint {
            header: Header { stamp: Time { sec, nanosec }, frame_id: String::new() },
            seq,
            normal_load_n: f64::from_bits(load),
            disc_speed_rad_s: f64::from_bits(speed),
            friction_coefficient: f64::from_bits(friction),
        };
        let back = OperatingPointForm::from_message(&message).expect("fits").to_message().expect("is one");
        prop_assert_eq!(back.header, message.header);
        prop_assert_eq!(back.seq, seq);
        prop_assert_eq!(
            [back.normal_load_n, back.disc_speed_rad_s, back.friction_coefficient].map(f64::to_bits),
            [load, speed, friction]
        );
    }

    #[test]
    fn no_bytes_panic(stamp_ns: i64, mode_count: u32, level: u8, reused: u8, reason_len: u8, byte: u8) {
        let good = PredictionForm::from_message(&prediction(3, "")).expect("fits");
        let reason = [byte; REASON_BYTES];
        let _ = PredictionForm { stamp_ns, mode_count, level, reused, reason_len, reason, ..good }.to_message();
    }

    #[test]
    fn any_reason_is_carried_up_to_a_character(reason: String) {
        let form = PredictionForm::from_message(&prediction(0, &reason)).expect("fits");
        let back = form.to_message().expect("is one").reason;
        prop_assert!(reason.starts_with(&back));
        prop_assert!(back == reason || back.len() + 4 > REASON_BYTES);
    }
}
