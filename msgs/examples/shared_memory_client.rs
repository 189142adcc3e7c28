//! A rig's own program: sends conditions to a node over shared memory and prints what the node predicts.
//!
//! ```sh
//! squealcast run nine-dof-case-2 --no-ros            # in one terminal
//! cargo run -p squealcast-msgs --example shared_memory_client    # in another
//! ```
//!
//! Optional arguments: how many conditions to send (default 10), and the service prefix of the node
//! (`--shm-prefix` of `squealcast run`).

use std::error::Error;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use iceoryx2::prelude::*;
use squealcast_msgs::shm::{Form, OperatingPointForm, PredictionForm};
use squealcast_msgs::{Header, OperatingPoint, Time, level};

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let count: u64 = arguments.next().map_or(Ok(10), |text| text.parse())?;
    let prefix = arguments.next().unwrap_or_default();

    let node = NodeBuilder::new().create::<ipc::Service>()?;
    let conditions_name = ServiceName::new(&format!("{prefix}{}", OperatingPointForm::SERVICE))?;
    let predictions_name = ServiceName::new(&format!("{prefix}{}", PredictionForm::SERVICE))?;

    // The node creates the services; it must be running.
    let conditions = node.service_builder(&conditions_name).publish_subscribe::<OperatingPointForm>().open()?;
    let predictions = node.service_builder(&predictions_name).publish_subscribe::<PredictionForm>().open()?;
    let wake_node = node.service_builder(&conditions_name).event().open()?.notifier_builder().create()?;
    let prediction_arrived = node.service_builder(&predictions_name).event().open()?.listener_builder().create()?;
    let publisher = conditions.publisher_builder().create()?;
    let subscriber = predictions.subscriber_builder().create()?;

    for seq in 1..=count {
        let now = SystemTime::now().duration_since(UNIX_EPOCH)?;
        let input = OperatingPoint {
            header: Header { stamp: Time::from_ns(now.as_nanos().try_into()?), frame_id: String::new() },
            seq,
            normal_load_n: 500.0,
            disc_speed_rad_s: 13.0,
            friction_coefficient: 0.3 + 0.3 * seq as f64 / count as f64,
        };
        publisher.send_copy(OperatingPointForm::from_message(&input)?)?;
        wake_node.notify()?;

        let deadline = Instant::now() + Duration::from_secs(5);
        'answer: loop {
            while let Some(sample) = subscriber.receive()? {
                let prediction = sample.payload().to_message()?;
                if prediction.input_seq == seq {
                    println!(
                        "friction {:.3}: {}, largest growth {:.1} 1/s, {}",
                        input.friction_coefficient,
                        level::name(prediction.level),
                        prediction.max_growth_rate_per_s,
                        prediction.reason
                    );
                    break 'answer;
                }
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(format!("no prediction for input {seq} within 5 s").into());
            }
            prediction_arrived.timed_wait(|_| {}, left)?;
        }
    }
    Ok(())
}
